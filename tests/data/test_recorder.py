import numpy as np
import pytest
from lerobot.datasets import LeRobotDataset
from synthetic_segments import FPS, STATE_DIM, observation_space, world
from synthetic_streams import PICTURES, RESET, TASKS, K, intervention, step, success

from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.data.schema import stream_features
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.protocol.interventions import Intervention


class Loop:
    """Feeds a recorder as a training loop would: every number says which stream and step it belongs to."""

    def __init__(self, num_envs: int):
        self.n, self.t = num_envs, 0
        self.space = observation_space(environment_state=None)

    def writer(self, root, **options):
        return SegmentWriter("me/stream", root, stream_features(world(self.space)), FPS, **options)

    def step(self, recorder: StreamRecorder, **changes):
        own = {"interventions": np.arange(self.n) + self.t // K}
        step(recorder, self.t, self.n, **(own | changes))
        self.t += 1


def streams_of(dataset: LeRobotDataset) -> dict[int, dict[str, np.ndarray]]:
    """Every stream put back together, by its id, from the order of the steps."""
    columns = dataset.hf_dataset.with_format("numpy")[:]
    streams = {}
    for stream in np.unique(columns["cronos.stream_id"]):
        mine = np.flatnonzero(columns["cronos.stream_id"] == stream)
        order = mine[np.argsort(columns["cronos.step"][mine])]
        streams[int(stream)] = {key: column[order] for key, column in columns.items()}
    return streams


def assert_whole(dataset: LeRobotDataset, num_streams: int, steps: int, num_envs: int | None = None):
    streams = streams_of(dataset)
    assert list(streams) == list(range(num_streams))
    t = np.arange(steps)
    for i, stream in streams.items():
        code = 1000 * i + t
        np.testing.assert_array_equal(stream["cronos.step"], t)
        np.testing.assert_array_equal(stream["cronos.segment_index"], t // K)
        np.testing.assert_array_equal(stream["observation.state"][:, 0], code)
        np.testing.assert_array_equal(stream["action"][:, 6], code / 2)
        np.testing.assert_array_equal(stream["next.reward"], code / 4)
        np.testing.assert_array_equal(stream["next.success"], [success(i, at) for at in t])
        np.testing.assert_array_equal(stream["cronos.log_prob"], -code / 8)
        np.testing.assert_array_equal(stream["cronos.value"], code / 16)
        np.testing.assert_array_equal(stream["cronos.policy_version"], t // (2 * K))
        np.testing.assert_array_equal(stream["cronos.stream_interventions"], i + t // K)
        n = num_envs or num_streams
        np.testing.assert_array_equal(stream["cronos.total_interventions"], n * (n - 1) // 2 + n * (t // K))
        np.testing.assert_array_equal(stream["cronos.segments_since_reset"], t % RESET // K)
        np.testing.assert_array_equal(stream["next.truncated"], t % K == K - 1)
        assert not stream["next.done"].any()
        np.testing.assert_array_equal(stream["cronos.event"], [intervention(at) for at in t])


def test_64_interleaved_streams_come_apart_again(tmp_path):
    loop = Loop(64)
    recorder = StreamRecorder(loop.writer(tmp_path / "d"), num_envs=64, segment_length=K)
    for _ in range(3 * K):
        loop.step(recorder)
    recorder.close()
    dataset = LeRobotDataset("me/stream", root=tmp_path / "d")
    assert dataset.num_episodes == 64 * 3
    assert_whole(dataset, 64, 3 * K)
    for index in (0, 100, 767):
        item = dataset[index]
        stream, t = int(item["cronos.stream_id"]), int(item["cronos.step"])
        assert item["task"] == TASKS[(stream + t // K) % 2]
        assert np.abs(item["observation.images.front"].numpy().transpose(1, 2, 0) * 255
                      - PICTURES[(stream + t) % 7]).mean() < 2.5  # fmt: skip


def test_one_episode_is_one_segment_of_one_stream(tmp_path):
    loop = Loop(3)
    recorder = StreamRecorder(loop.writer(tmp_path / "d"), num_envs=3, segment_length=K)
    for _ in range(2 * K):
        loop.step(recorder)
    recorder.close()
    episodes = LeRobotDataset("me/stream", root=tmp_path / "d").meta.episodes
    found = [(e["cronos.stream_id"], e["cronos.segment_index"], e["cronos.step"], e["length"]) for e in episodes]
    assert found == [(i, k, k * K, K) for k in range(2) for i in range(3)]
    assert episodes["cronos.event"] == [Intervention.INITIAL] * 3 + [Intervention.END_EFFECTOR_RESET] * 3
    assert episodes["next.success"] == [any(success(i, t) for t in range(k * K, k * K + K))
                                        for k in range(2) for i in range(3)]  # fmt: skip


def test_records_only_the_first_streams(tmp_path):
    loop = Loop(5)
    recorder = StreamRecorder(loop.writer(tmp_path / "d"), num_envs=5, segment_length=K, streams=2)
    for _ in range(K):
        loop.step(recorder)
    recorder.close()
    assert_whole(LeRobotDataset("me/stream", root=tmp_path / "d"), 2, K, num_envs=5)


@pytest.mark.parametrize("checkpoint_at", [2 * K, 2 * K + 3], ids=["between segments", "inside one"])
def test_resumes_at_a_checkpoint_without_gap_or_duplicate(tmp_path, checkpoint_at):
    loop = Loop(3)
    recorder = StreamRecorder(loop.writer(tmp_path / "d"), num_envs=3, segment_length=K)
    for _ in range(checkpoint_at):
        loop.step(recorder)
    state = recorder.state_dict()
    for _ in range(K + 1):  # goes on past the checkpoint, then stops
        loop.step(recorder)
    recorder.close()

    loop.t = checkpoint_at
    writer = loop.writer(tmp_path / "d", resume=state["num_episodes"])
    recorder = StreamRecorder(writer, num_envs=3, segment_length=K)
    recorder.load_partial_segments(state)
    while loop.t < 5 * K:
        loop.step(recorder)
    recorder.close()
    dataset = LeRobotDataset("me/stream", root=tmp_path / "d")
    assert_whole(dataset, 3, 5 * K)
    assert dataset.num_episodes == 3 * 5


def test_a_run_that_ends_inside_a_segment_keeps_its_frames(tmp_path):
    loop = Loop(2)
    recorder = StreamRecorder(loop.writer(tmp_path / "d"), num_envs=2, segment_length=K)
    for _ in range(K + 2):
        loop.step(recorder)
    recorder.close()
    assert_whole(LeRobotDataset("me/stream", root=tmp_path / "d"), 2, K + 2)


@pytest.mark.parametrize("describes", [(), ("value",)], ids=["no critic", "a critic"])
def test_what_the_agent_does_not_know_is_no_column(tmp_path, describes):
    """Not a probability of 1, and not a value of 0."""
    loop = Loop(1)
    writer = SegmentWriter(
        "me/stream", tmp_path / "d", stream_features(world(loop.space), describes=describes), FPS
    )
    recorder = StreamRecorder(writer, num_envs=1, segment_length=K)
    for _ in range(K):
        loop.step(recorder, log_prob=None, **({} if describes else {"value": None}))
    recorder.close()
    columns = LeRobotDataset("me/stream", root=tmp_path / "d").meta.features
    assert {"cronos.log_prob", "cronos.value"} & columns.keys() == {f"cronos.{name}" for name in describes}


def test_buffers_are_copies(tmp_path):
    loop = Loop(1)
    recorder = StreamRecorder(loop.writer(tmp_path / "d"), num_envs=1, segment_length=K)
    state = np.zeros((1, STATE_DIM), np.float32)
    pictures = PICTURES[:1].copy()
    for t in range(K):
        state[:] = t
        loop.step(recorder, observation={"pixels": {"front": pictures}, "agent_pos": state})
    recorder.close()
    rows = LeRobotDataset("me/stream", root=tmp_path / "d").hf_dataset.with_format("numpy")[:]
    np.testing.assert_array_equal(rows["observation.state"][:, 0], np.arange(K))


@pytest.mark.parametrize(
    ("at", "overrides"),
    [
        (0, {"preceded_by": np.array([0, 0])}),
        (2, {"preceded_by": np.array([0, 4])}),
        (2, {"instructions": [TASKS[0], "other"]}),
        (K, {"preceded_by": np.array([0, 0]), "instructions": list(TASKS)}),
    ],
    ids=["no event at the start", "an event inside", "another instruction", "too long"],
)
def test_a_loop_that_breaks_the_contract_is_told(tmp_path, at, overrides):
    loop = Loop(2)
    recorder = StreamRecorder(loop.writer(tmp_path / "d"), num_envs=2, segment_length=K)
    for _ in range(at):
        loop.step(recorder, cut=np.zeros(2, bool))
    with pytest.raises(ValueError, match=rf"^stream \d, step {at}: "):
        loop.step(recorder, **overrides)
    recorder.writer.finalize()


@pytest.mark.parametrize("streams", [0, 3, "some"])
def test_unknown_number_of_streams(tmp_path, streams):
    with Loop(2).writer(tmp_path / "d") as writer, pytest.raises(ValueError, match="streams must be"):
        StreamRecorder(writer, num_envs=2, segment_length=K, streams=streams)

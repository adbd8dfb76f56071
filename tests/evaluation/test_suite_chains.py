"""Which chains the suites run, and how the bodies of a stream lie."""

import numpy as np
from lerobot_env_cronos import CronosVectorEnv, get_scene, load_benchmark
from tiny_checkpoints import STATE

from cronos_lerobot.evaluation.actors import ExpertActor
from cronos_lerobot.evaluation.chains import Chain, ChainRunner, Rules
from cronos_lerobot.evaluation.suites import Start, classify_starts, make_chains

BENCHMARK = load_benchmark(None, "kitchen_2x2")
TASKS = get_scene("kitchen_2x2").tasks


def test_chains_of_each_suite():
    independent = make_chains(BENCHMARK, "independent", "train", 2)
    assert independent == [Chain(i, (task,), c) for i, task in enumerate(TASKS) for c in (0, 1)]
    sequential = make_chains(BENCHMARK, "sequential", "held_out", 3, orderings=2)
    assert [(c.number, c.configuration) for c in sequential] == [(i, c) for i in (0, 1) for c in range(3)]
    assert {frozenset(chain.tasks) for chain in sequential} == {frozenset(TASKS)}
    streams = make_chains(BENCHMARK, "stream", "train")
    assert [chain.configuration for chain in streams] == list(range(64))
    # The training cycle, from another task in each configuration.
    assert streams[6].tasks == (*TASKS[2:], *TASKS * 3, *TASKS[:2])
    assert streams[6].number == 2


class ExpertInTurns(ExpertActor):
    """The expert in the given segments; holds still in the others."""

    def __init__(self, env, *segments):
        super().__init__(env)
        self.segments, self.segment = segments, -1

    def begin(self, ids, seeds=None):
        super().begin(ids)
        self.segment += 1

    def act(self, observation, instructions, ids):
        chosen = super().act(observation, instructions, ids)
        if self.segment not in self.segments:
            chosen.action[:] = [0, 0, 0, 0, 0, 0, 1]
        return chosen


def run_streams(length, *segments, **rules):
    env = CronosVectorEnv(4, **STATE)
    chains = [Chain(i, (*TASKS[i:], *TASKS, *TASKS)[:length], i) for i in range(4)]
    runner = ChainRunner(env, ExpertInTurns(env, *segments), Rules(stops=False, **rules), look=classify_starts)
    return runner.run(chains, "train", (0,))


def test_starts_of_streams_in_which_the_first_task_alone_is_done():
    results = run_streams(5, 0, end_effector_reset=True)
    assert [list(r.success) for r in results] == [[True, False, False, False, True]] * 4
    assert [(r.found_complete, r.never_grasped) for r in results] == [([4], [])] * 4
    # Tasks: (bottle, plate), (bottle, cloth), (shovel, plate), (shovel, cloth); stream i begins with task i.
    other, occupied, free = Start.ON_OTHER_RECEPTACLE, Start.RECEPTACLE_OCCUPIED, Start.FREE
    by_segment = list(zip(*(r.starts for r in results), strict=True))
    assert by_segment[0] == (free,) * 4
    assert by_segment[1] == (other, free, other, free)
    assert by_segment[2] == (occupied,) * 4
    assert by_segment[3] == (free, other, free, other)
    assert by_segment[4] == (Start.COMPLETE,) * 4


def test_bodies_that_no_task_can_reach():
    env = CronosVectorEnv(4, **STATE)
    away, below = [[0.8, 0.5, -0.74, 1, 0, 0, 0]], [[0.3, 0.0, -0.5, 1, 0, 0, 0]]
    env.simulation.move_body(np.array([1]), "ketchup bottle", np.array([[0.6, 0.5, 0.02, 1, 0, 0, 0]]))
    env.simulation.move_body(np.array([2]), "cloth", np.array(away))
    env.simulation.move_body(np.array([3]), "yellow plate", np.array(below))
    # All are told to put the bottle on the plate: the cloth does not matter.
    starts = [Start.FREE, Start.OUT_OF_REACH, Start.FREE, Start.FALLEN]
    assert classify_starts(env, np.arange(4)) == starts
    assert classify_starts(env, np.array([3, 0])) == [Start.FALLEN, Start.FREE]

"""What the runs of an experiment began with: policies of several commits are told apart."""

import json
from dataclasses import replace

from experiment_runs import make_run

from cronos_lerobot.experiments.definitions import EXPERIMENTS
from cronos_lerobot.experiments.outputs import write_outputs


def test_commits_of_a_policy_of_the_hub_that_differ_are_said(options, tmp_path):
    """Such a policy has no fingerprint; seeds may begin before and after it is pushed anew."""
    experiment, options = EXPERIMENTS["table1"], replace(options, policy_path="me/policy")
    for seed, commit in ((1, "aaaa"), (2, "bbbb")):
        manifest = make_run(options, "table1", "t80", seed, (2, 4, 5)).train_folder / "manifest.json"
        (start,) = json.loads(manifest.read_text())["starts"]
        start["config"]["policy"] = {"pretrained_path": "me/policy", "pretrained_revision": commit}
        # A resume loads the run's own checkpoint, which is of no commit.
        resumed = json.loads(json.dumps(start))
        resumed["config"]["policy"] = {"pretrained_path": "a/checkpoint", "pretrained_revision": None}
        starts = [start | {"policy_fingerprint": None}, resumed | {"policy_fingerprint": "own"}]
        manifest.write_text(json.dumps({"starts": starts}))
        page = write_outputs(experiment, experiment.rows, options, tmp_path / "out")
        assert ("Not one base policy" in page) == (seed == 2)
    assert "- me/policy@aaaa: t80 seed 1\n- me/policy@bbbb: t80 seed 2" in page
    bases = json.loads((tmp_path / "out/table1.json").read_text())["bases"]
    assert bases == {"--policy.path": ["me/policy@aaaa", "me/policy@bbbb"]}

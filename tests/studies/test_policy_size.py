"""Operations and bytes of large policies, against what is published and what can be worked out by hand."""

import sys

import pytest

from cronos_lerobot.studies import policy_size
from cronos_lerobot.studies.policy_size import CASES, count

STEPS = 3


@pytest.fixture(scope="module")
def costs():
    """With fewer steps from noise to action than SmolVLA's ten: each is the same arithmetic."""
    cases = {name: CASES[name] for name in ("smolvla", "smolvla, noise at 1 step")}
    return {name: count(kind, own | {"num_steps": STEPS}, noise) for name, (kind, own, noise) in cases.items()}


def test_smolvla_has_its_published_size(costs):
    cost = costs["smolvla"]
    # Shukor et al. (2025): 450 million parameters, about 100 million of them in the action expert.
    assert cost.parameters == pytest.approx(450e6, rel=0.005)
    assert cost.trained == pytest.approx(100e6, rel=0.01)
    assert cost.weight_bytes == 4 * cost.parameters
    assert cost.state_bytes == 12 * cost.trained


def test_operations_are_those_of_the_layers(costs):
    whole, one = costs.values()
    # SigLIP reads 1024 patches with 12 layers of 768: 4 + 8 matrices of 768 x 768, and twice 1024 x 1024 x 768.
    vision = 12 * 2 * (1024 * 12 * 768**2 + 2 * 1024**2 * 768) + 2 * 1024 * 768 * 3 * 16**2
    assert vision < whole.value < 1.4 * vision
    assert whole.value == one.value
    assert whole.act == one.act
    # A step: 50 tokens through the expert's 98 million parameters, and attention to 113 tokens.
    step = (whole.act - whole.value) / STEPS
    assert step == pytest.approx(2 * 50 * 98e6, rel=0.5)
    # Forwards, backwards to the inputs and to the weights, at all steps or at one.
    assert (whole.update - one.update) / (STEPS - 1) == pytest.approx(3 * step, rel=0.15)
    assert one.activation_bytes < whole.activation_bytes


def test_the_command_prints_what_it_counts(costs, monkeypatch, capsys):
    name = "smolvla, noise at 1 step"
    asked = []
    monkeypatch.setattr(policy_size, "count", lambda *case, **sizes: asked.append((case, sizes)) or costs[name])
    monkeypatch.setattr(sys, "argv", ["policy_size", "--cases", name, "--utilisation=1"])
    policy_size.main()
    line = policy_size.json.loads(capsys.readouterr().out.splitlines()[-1])
    assert line["case"] == name
    assert asked == [(CASES[name], {"words": 48, "played": 10})]
    assert line["estimate"]["act_ms"] == pytest.approx(line["act"] / 495e9, abs=0.01)
    assert line["estimate"]["fixed_gb"] == pytest.approx(1.8 + 1.2, abs=0.05)

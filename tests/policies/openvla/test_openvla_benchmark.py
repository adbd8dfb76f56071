"""The formulas against PyTorch's own count of operations, and the command."""

import json

import pytest
import torch
from lerobot_policy_openvla.arithmetic import update_bytes, work_of
from lerobot_policy_openvla.benchmark import architecture_of_size, main
from lerobot_policy_openvla.benchmark_report import report
from lerobot_policy_openvla.network_loading import empty_network
from openvla_samples import make_batch, make_policy, take
from torch.utils.flop_counter import FlopCounterMode, sdpa_backward_flop_count, sdpa_flop_count

ON_CPU = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu
ON_CPU_BACKWARD = torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward


def counted(function) -> int:
    """PyTorch counts attention on GPUs; its formulas are lent to the CPU's here."""
    formulas = {
        ON_CPU: lambda q, k, v, *_, **__: sdpa_flop_count(q, k, v),
        ON_CPU_BACKWARD: lambda grad, q, k, v, *_, **__: sdpa_backward_flop_count(grad, q, k, v),
    }
    with FlopCounterMode(display=False, custom_mapping=formulas) as counter:
        function()
    return counter.get_total_flops()


@pytest.mark.parametrize("rank", [0, 4])
def test_operations_are_what_pytorch_counts(published, rank):
    policy = make_policy(published, lora_rank=rank)
    batch = take(make_batch(1), [0])
    work = work_of(policy.network, len(policy.prompt_tokenizer(batch["task"][0])), 7)
    with torch.no_grad():
        value_head = counted(lambda: policy.value_head(torch.zeros(1, 64)))
        acting = counted(lambda: policy.sample_actions(batch)) - value_head
        prompt = counted(lambda: policy.predict_values(batch)) - value_head
    length = len(policy.prompt_tokenizer(batch["task"][0])) + 16
    assert work.rollout == pytest.approx(acting, rel=1e-3)
    # The critic alone needs no output layer and no room for six more tokens (two layers of width 64).
    spared = 2 * 64 * 704 + (2 * rank * (64 + 704)) + 2 * 4 * 64 * length * 6
    assert work.vision + work.prompt - spared == pytest.approx(prompt, rel=1e-3)


@pytest.mark.parametrize("recompute", [False, True])
@pytest.mark.parametrize("vision", [False, True])
def test_operations_of_learning(published, vision, recompute):
    """Within 10 %: the first layers' backward pass is shorter, and a recomputation stops before its end."""
    parts = ["projector", "language"] + ["vision"] * vision
    policy = make_policy(published, lora_rank=4, lora_modules=parts, gradient_checkpointing=recompute)
    batch = take(make_batch(1), [0])
    tokens = torch.full((1, 7), 500)

    def learn():
        policy.evaluate_actions(batch, tokens)["log_prob"].sum().backward()

    work = work_of(policy.network, len(policy.prompt_tokenizer(batch["task"][0])), 7)
    formula = work.update(vision_trained=vision, vision_kept=False, recompute=recompute)
    assert formula == pytest.approx(counted(learn), rel=0.1)


def test_the_published_size():
    """6.7 G weights of Llama-2 and its 13.5 GB; 283 positions at 2 operations a weight are 3.7 TFLOP."""
    network = empty_network(architecture_of_size("7b"), "sdpa")
    llama = sum(p.numel() for p in network.language_model.parameters())
    assert llama == 6_738_415_616 + 2 * 64 * 4096
    # DINOv2 ViT-L/14 with 304 M weights and SigLIP so400m/14 with 412 M (no pooling), each less its last block.
    towers = sum(p.numel() for p in network.vision_backbone.parameters())
    assert towers == pytest.approx(304e6 * 23 / 24 + 412e6 * 26 / 27, rel=0.01)
    assert network.projector.fc1.weight.shape == (8704, 2176)
    work = work_of(network, 26, 7)
    layers = llama - 2 * 32064 * 4096
    assert work.prompt == pytest.approx(2 * 282 * layers + 2 * 256 * 72.3e6, rel=0.02)
    assert work.decode == pytest.approx(6 * 2 * (layers + 32064 * 4096), rel=0.02)
    # Nothing trained: two passes over float32 weights, shared by a minibatch of 8.
    network.requires_grad_(False)
    total = sum(p.numel() for p in network.parameters())
    assert update_bytes(network, 8, 20, recompute=False) == pytest.approx(2 * 4 * total / 8)


def test_the_command(tmp_path, capsys):
    output = tmp_path / "numbers.json"
    main(["--size=tiny", "--device=cpu", "--streams=2", "--seconds=0", "--dtype=bfloat16", f"--output={output}"])
    printed = capsys.readouterr().out
    assert "H100" in printed
    assert "minibatches of 8" in printed
    result = json.loads(output.read_text())
    assert report(result) + "\n" == printed
    assert result["rollout_s"]["whole"] > 0
    # bfloat16, but for what is trained.
    assert result["memory_bytes"]["weights"] == 2 * result["parameters"] + 2 * result["trained"]

"""What commands compute with: nothing newer than AVX2, and clones the same on the processors of all makers."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tiny_jobs import python_job, run

from cronos_lerobot.experiments.arithmetic import AVX2, CLONING, portable_arithmetic

CAPABILITY = torch.backends.cpu.get_cpu_capability()
HELD = CAPABILITY in ("AVX2", "AVX512")
CLONE = Path(__file__).parents[1] / "policies" / "pocketvla" / "cloned_anywhere.py"


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr("cronos_lerobot.experiments.runner.POLL_S", 0.02)


def test_commands_are_held_to_avx2_unless_a_user_says_otherwise(tmp_path, monkeypatch):
    for name in AVX2:
        monkeypatch.delenv(name, raising=False)
    code = "import os, torch; (out / 'found').write_text(torch.backends.cpu.get_cpu_capability() + ' '"
    code += " + os.environ.get('MKL_CBWR', 'unset'))"
    run([python_job(tmp_path, "a", code)])
    assert (tmp_path / "a/found").read_text() == ("AVX2 AVX2" if HELD else f"{CAPABILITY} unset")
    monkeypatch.setenv("MKL_CBWR", "COMPATIBLE")
    monkeypatch.setenv("ATEN_CPU_CAPABILITY", "default")
    run([python_job(tmp_path, "b", code)])
    assert (tmp_path / "b/found").read_text() == ("DEFAULT COMPATIBLE" if HELD else f"{CAPABILITY} COMPATIBLE")


@pytest.mark.skipif(not HELD, reason="this processor has no AVX2")
def test_the_command_that_clones_takes_the_path_of_all_makers(tmp_path, monkeypatch):
    monkeypatch.delenv("MKL_CBWR", raising=False)
    code = "import os; (out / 'found').write_text(os.environ['MKL_CBWR'])"
    for cloning, path in ((CLONING, "AVX2"), ("python", "COMPATIBLE")):
        monkeypatch.setattr("cronos_lerobot.experiments.arithmetic.CLONING", cloning)
        run([python_job(tmp_path, cloning, code)])
        assert (tmp_path / cloning / "found").read_text() == path


@pytest.mark.skipif(not HELD, reason="this processor has no AVX2")
def test_policies_of_pictures_are_cloned_in_float32_where_avx2_is_all_they_get():
    """On a processor with bfloat16 of its own, as any is here, it was emulated: slower, and another policy."""
    code = "import torch; torch.cpu.get_capabilities = lambda: {'avx512_bf16': True};"
    code += "from lerobot_policy_pocketvla.precision import use_bfloat16; print(use_bfloat16('auto', 'cpu'))"
    environment = os.environ | portable_arithmetic(CLONING)
    assert subprocess.check_output([sys.executable, "-c", code], env=environment, text=True).strip() == "False"


@pytest.mark.skipif(not HELD, reason="this processor has no AVX2")
def test_a_clone_is_the_same_on_every_processor():
    """The hash is that of a Zen 3 EPYC, natively, and of an Intel Haswell, as QEMU emulates it."""
    environment = os.environ | portable_arithmetic(CLONING)
    found = subprocess.run([sys.executable, CLONE], env=environment, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "bb5cf2b3c3b099eb"

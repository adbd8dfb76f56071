"""A fixed piece of what the demo does, physics and learning, to tell how fast this machine is.

python -m cronos_lerobot.scripts.probe      # prints the seconds that it took
"""

from __future__ import annotations

import subprocess
import sys
import time

REPETITIONS = 3
CONTROL_STEPS = 40
GRADIENT_STEPS = 30


def measure() -> float:
    """Seconds of the piece in a process of its own; the fastest of some repetitions.

    Raises:
        subprocess.CalledProcessError: it failed; its standard error has been shown.
    """
    command = [sys.executable, "-m", "cronos_lerobot.scripts.probe"]
    return float(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout.split()[-1])


def main() -> None:
    """Do the piece a few times and print the seconds of the fastest."""
    # A command that only starts this one needs neither.
    import torch
    from lerobot_env_cronos import CronosVectorEnv

    env = CronosVectorEnv(64, obs_type="environment_state_agent_pos")
    actions = env.action_space
    actions.seed(0)
    env.reset(seed=0)
    network = torch.nn.Sequential(torch.nn.Linear(128, 512), torch.nn.ReLU(), torch.nn.Linear(512, 512))
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4)
    batch = torch.linspace(-1, 1, 2048 * 128).reshape(2048, 128)

    def piece() -> float:
        start = time.perf_counter()
        for _ in range(CONTROL_STEPS):
            env.step(actions.sample())
        for _ in range(GRADIENT_STEPS):
            optimizer.zero_grad()
            network(batch).square().mean().backward()
            optimizer.step()
        return time.perf_counter() - start

    piece()
    print(min(piece() for _ in range(REPETITIONS)))
    env.close()


if __name__ == "__main__":
    main()

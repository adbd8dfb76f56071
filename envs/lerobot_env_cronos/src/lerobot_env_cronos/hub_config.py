"""`--env.type=cronos_hub`: the environments that a benchmark's repository makes itself, by LeRobot's EnvHub."""

from dataclasses import dataclass
from typing import Any, TypeGuard

from lerobot.envs.configs import EnvConfig, HubEnvConfig

from lerobot_env_cronos.benchmark.files import check_tag, fetch_benchmark
from lerobot_env_cronos.benchmark.load import load_benchmark
from lerobot_env_cronos.config import CronosEnvConfig


@EnvConfig.register_subclass("cronos_hub")
@dataclass
class CronosHubEnvConfig(CronosEnvConfig, HubEnvConfig):
    """The fields of `--env.type=cronos`, but LeRobot runs the `env.py` of `--env.hub_path`.

    `--trust_remote_code=true` allows its code to run. What a policy sees follows from the data beside it.
    """

    hub_path: str | None = None
    """<owner>/<repository>[@<revision>] of a model repository that `cronos-publish benchmark` has made."""

    def _build(self) -> None:
        if not self.hub_path:
            raise ValueError("env.type=cronos_hub needs env.hub_path: <owner>/<repository>[@<revision>]")
        name = self.hub_path.partition(":")[0]
        folder, _ = fetch_benchmark(name, repo_type="model")
        if self.benchmark not in (None, str(folder)):
            raise ValueError(f"env.benchmark is that of env.hub_path={self.hub_path}; got {self.benchmark!r}")
        self.benchmark = str(folder)
        super()._build()
        check_tag(load_benchmark(self.benchmark, self.scene), name)


def is_of_this_package(env: Any) -> TypeGuard[CronosEnvConfig]:
    """Whether an environment config is of environments that this package makes, not a repository's own code."""
    return isinstance(env, CronosEnvConfig) and not isinstance(env, HubEnvConfig)

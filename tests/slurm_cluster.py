"""A real Slurm of one node for tests: munged, slurmctld and slurmd in a folder, on ports of their own."""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scontrol")
CONFIG = """\
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
ReturnToService=2
KillWait=1
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
SchedulerParameters=sched_interval=1,batch_sched_delay=0,sched_min_interval=100000
NodeName={host} NodeAddr=127.0.0.1 CPUs=4 Boards=1 SocketsPerBoard=4 RealMemory=1000 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def missing() -> list[str]:
    """The programs of Debian's slurm-wlm and munge that are not here."""
    return [name for name in PROGRAMS if not shutil.which(name, path=_path())]


def _path() -> str:
    return f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"


def _free_ports(number: int) -> list[int]:
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(number)]
    ports = [made.getsockname()[1] for made in sockets]
    for made in sockets:
        made.close()
    return ports


class SlurmCluster:
    """Starts on `__enter__`, which sets SLURM_CONF for this process, and stops on `__exit__`.

    Args:
        folder: empty, with a short path: it holds sockets.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._before = os.environ.get("SLURM_CONF")

    def __enter__(self) -> SlurmCluster:
        for name in ("state", "spool"):
            (self.folder / name).mkdir()
        # munged wants nobody else to be able to write where its socket is.
        self.folder.chmod(0o755)
        key = self.folder / "munge.key"
        key.write_bytes(secrets.token_bytes(1024))
        key.chmod(0o600)
        files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
        munge = [f"--{flag}={self.folder}/munge.{end}" for flag, end in files.items()]
        host = socket.gethostname().split(".")[0]
        user = subprocess.run(["id", "-un"], capture_output=True, text=True, check=True).stdout.strip()
        config = self.folder / "slurm.conf"
        config.write_text(CONFIG.format(host=host, ports=_free_ports(2), user=user, folder=self.folder))
        os.environ["SLURM_CONF"] = str(config)
        self._start("munged", *munge, "--force")
        self._start("slurmctld", "-f", str(config))
        self._start("slurmd", "-f", str(config))
        self._wait_for_node()
        return self

    def _start(self, program: str, *flags: str) -> None:
        """Start a daemon, which goes to the background by itself."""
        environment = os.environ | {"PATH": _path()}
        subprocess.run([program, *flags], check=True, env=environment, stdin=subprocess.DEVNULL, timeout=30)

    def _wait_for_node(self) -> None:
        deadline = time.monotonic() + 30
        while "idle" not in self.ask("sinfo", "--noheader", "--format=%t"):
            if time.monotonic() > deadline:
                raise RuntimeError(f"Slurm's node does not come up:\n{self.logs()}")
            time.sleep(0.2)

    def logs(self) -> str:
        """The ends of its logs, for a test that fails."""
        return "\n".join(path.read_text()[-4000:] for path in sorted(self.folder.glob("*.log")))

    def ask(self, *command: str) -> str:
        """What a command of Slurm answers."""
        return subprocess.run(command, capture_output=True, text=True, timeout=30).stdout

    @contextmanager
    def sparing_the_wait(self, also: Callable[[], object] = lambda: None) -> Iterator[None]:
        """Requeued jobs start after two seconds, for which Slurm takes two minutes; `also` is called meanwhile.

        In the second in which a job was stopped, its node takes a new start for the old one: "already killed".
        """
        ended = threading.Event()

        def hurry() -> None:
            held: dict[str, float] = {}
            while not ended.wait(0.5):
                also()
                lines = self.ask("squeue", "--noheader", "--format=%i %T %r").splitlines()
                waiting = {line.split()[0] for line in lines if line.split()[1:] == ["PENDING", "BeginTime"]}
                held = {number: held.get(number, time.monotonic()) for number in waiting}
                for number, since in held.items():
                    if time.monotonic() - since >= 2:
                        self.ask("scontrol", "update", f"JobId={number}", "StartTime=now")

        thread = threading.Thread(target=hurry)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def __exit__(self, *_: object) -> None:
        self.ask("scancel", "--full", f"--user={os.getuid()}")
        for name in ("slurmd", "slurmctld", "munge"):
            # They would take seconds to end in order, and leave nothing that is looked at.
            with suppress(OSError, ValueError):
                os.kill(int((self.folder / f"{name}.pid").read_text()), signal.SIGKILL)
        # What watches over a job (slurmstepd) would look for the controller for minutes.
        for step in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                is_ours = f"SLURM_CONF={os.environ['SLURM_CONF']}\0".encode() in (step / "environ").read_bytes()
                if is_ours and (step / "comm").read_text().strip() == "slurmstepd":
                    os.kill(int(step.name), signal.SIGKILL)
        if self._before is None:
            os.environ.pop("SLURM_CONF", None)
        else:
            os.environ["SLURM_CONF"] = self._before

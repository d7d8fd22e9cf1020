"""A Slurm of one's own for a test: controller and node on this machine, loopback only, no munge, no accounting."""

import contextlib
import ctypes
import getpass
import os
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

WAIT_SECONDS = 60.0
MISSING = shutil.which("slurmctld") is None or shutil.which("slurmd") is None
CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
AuthType=auth/none
CredType=cred/none
AuthInfo=cred_expire=5
SlurmUser={user}
SlurmdUser={user}
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SwitchType=switch/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
MinJobAge=3600
KillWait={kill_wait}
ReturnToService=2
SchedulerParameters=batch_sched_delay=0,sched_interval=2,sched_min_interval=0,bf_interval=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory={memory} State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES DefMemPerCPU=1500 MaxTime=60 State=UP
"""


def _die_with_parent() -> None:
    """Linux's prctl: SIGKILL when the parent dies."""
    ctypes.CDLL(None).prctl(1, 9)


@contextlib.contextmanager
def cluster(folder: Path, cpus: int = 2, memory: int = 4000, kill_wait: int = 30) -> Iterator[Path]:
    """Start both daemons and wait until the node is idle; at the end cancel all jobs and stop the daemons.

    Yields:
        The configuration, which ``SLURM_CONF`` must name.
    """
    for name in ("state", "spool"):
        (folder / name).mkdir(parents=True)
    host = socket.gethostname().partition(".")[0]
    values = {"host": host, "ports": free_ports(2), "user": getpass.getuser(), "folder": folder}
    values |= {"cpus": cpus, "memory": memory, "kill_wait": kill_wait}
    path = folder / "slurm.conf"
    path.write_text(CONFIGURATION.format(**values))
    environment = {**os.environ, "SLURM_CONF": str(path)}
    with (folder / "daemons.log").open("w") as log:
        daemons = [
            subprocess.Popen([name, "-D"], stdout=log, stderr=log, env=environment, preexec_fn=_die_with_parent)
            for name in ("slurmctld", "slurmd")
        ]
    try:
        until = time.monotonic() + WAIT_SECONDS
        while (state := told("sinfo", "--noheader", "--format=%t", env=environment)) != "idle":
            if time.monotonic() > until or any(daemon.poll() is not None for daemon in daemons):
                logs = "\n".join(log.read_text() for log in folder.glob("*.log"))
                raise RuntimeError(f"Slurm does not start ({state}): {logs[-2000:]}")
            time.sleep(0.1)
        yield path
    finally:
        told("scancel", f"--user={getpass.getuser()}", env=environment)
        until = time.monotonic() + WAIT_SECONDS
        while told("squeue", "--noheader", env=environment) and time.monotonic() < until:
            time.sleep(0.2)
        for daemon in reversed(daemons):
            daemon.terminate()
            daemon.wait()


def told(*words: str, env: dict[str, str]) -> str:
    """What a command prints; nothing where it fails."""
    done = subprocess.run(words, capture_output=True, text=True, env=env, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""


def free_ports(count: int) -> list[int]:
    """Ports that nobody listens on now."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [int(one.getsockname()[1]) for one in sockets]

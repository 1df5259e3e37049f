"""Run a command with a Slurm cluster of this machine alone.

    python scripts/one_node_slurm.py bash
    python scripts/one_node_slurm.py autdtorch -m hydra/launcher=slurm hydra.launcher.cpus_per_task=1 ...

Daemons, keys, ports and files lie in a temporary folder, beside any Slurm of the machine. The cluster needs
neither systemd nor root; root installs missing programs from Debian's packages. It keeps no accounts. A task
is bound to the cores that it asks for, and a job gets a second from SIGTERM to SIGKILL. Jobs submitted with
`--requeue` are queued again after 10 s instead of Slurm's 120 s.
"""

import contextlib
import getpass
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

PACKAGES = ("slurmctld", "slurmd", "slurm-client", "munge")
PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch")

PATIENCE = 30.0  # [s] for daemons to start and jobs to end; an idle machine takes less than 1 s

CONFIG = """\
ClusterName=one
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthInfo=socket={folder}/munge.socket,cred_expire=10
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/affinity
TaskPluginParam=Cores
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
SchedulerParameters=sched_interval=1
FirstJobId={first_job}
JobRequeue=0
KillWait=1
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory={memory}
PartitionName=cpu Nodes={host} Default=YES
"""


def main() -> None:
    command = sys.argv[1:]
    if command in ([], ["-h"], ["--help"]):
        print(__doc__)
        sys.exit(0 if command else 2)
    signal.signal(signal.SIGINT, lambda *_: None)  # Ctrl-C is for the command alone
    try:
        if missing_programs():
            install()
        with one_node_slurm() as environment:
            status = subprocess.run(command, env=environment).returncode
    except (OSError, RuntimeError) as error:
        sys.exit(f"one_node_slurm: {error}")
    sys.exit(status)


def missing_programs() -> list[str]:
    """Return the programs of Slurm that this machine lacks."""
    return [name for name in PROGRAMS if _program(name) is None]


def install() -> None:
    """Install Slurm; RuntimeError if that fails, or if this process is not root."""
    if os.getuid() != 0 or shutil.which("apt-get") is None:
        raise RuntimeError(f"no {', '.join(missing_programs())}; root installs {' '.join(PACKAGES)}")
    for arguments in (["update"], ["install", "--yes", "--no-install-recommends", *PACKAGES]):
        command = ["apt-get", "-qq", *arguments]
        quiet = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
        done = subprocess.run(command, env=quiet, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)}: {done.stderr.strip().splitlines()[-1]}")


@contextlib.contextmanager
def one_node_slurm() -> Iterator[dict[str, str]]:
    """Run the cluster within the context, whose end kills remaining jobs; RuntimeError if it does not start.

    Yields:
        The environment in which Slurm's commands, such as sbatch, find the cluster.
    """
    with tempfile.TemporaryDirectory(prefix="slurm-") as name, contextlib.ExitStack() as daemons:
        folder = Path(name)  # short: the path of a socket has at most 107 characters
        _configure(folder)
        environment = os.environ | {"SLURM_CONF": f"{folder}/slurm.conf"}

        def start(program: str, *options: str) -> None:
            with (folder / f"{program}.log").open("wb") as log:
                command = [str(_program(program)), *options]
                # Ctrl-C must not reach the daemons, which end the jobs.
                daemon = subprocess.Popen(
                    command, env=environment, stdout=log, stderr=log, start_new_session=True
                )
            daemons.callback(daemon.wait)
            daemons.callback(daemon.terminate)

        def answer(*command: str) -> str:
            return subprocess.run(command, env=environment, capture_output=True, text=True).stdout.strip()

        socket_file = folder / "munge.socket"
        files = [f"--{kind}-file={folder}/munge.{kind}" for kind in ("key", "log", "pid", "seed")]
        start("munged", "--foreground", f"--socket={socket_file}", *files)
        _wait(socket_file.exists, folder)
        start("slurmctld", "-D")
        start("slurmd", "-D")
        _wait(lambda: answer("sinfo", "--noheader", "--format=%T") == "idle", folder)
        try:
            yield environment
        finally:
            answer("scancel", "--me")
            _wait(lambda: not answer("squeue", "--noheader"), folder)


def _program(name: str) -> str | None:
    """Return the path of a program, also in the folders of daemons."""
    return shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin")


def _configure(folder: Path) -> None:
    for name in ("state", "spool"):
        (folder / name).mkdir()
    folder.chmod(0o711)  # clients refuse a socket that others cannot reach
    key = folder / "munge.key"
    key.touch(mode=0o600)
    key.write_bytes(os.urandom(1024))
    with socket.socket() as one, socket.socket() as other:
        for free in (one, other):
            free.bind(("127.0.0.1", 0))
        ports = [free.getsockname()[1] for free in (one, other)]
    config = CONFIG.format(
        folder=folder,
        host=socket.gethostname().partition(".")[0],
        user=getpass.getuser(),
        ports=ports,
        first_job=int(time.time()) % 60_000_000,  # new each time: submitit keeps results by number
        cores=len(os.sched_getaffinity(0)),
        memory=os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2**21,  # half, in MB
    )
    (folder / "slurm.conf").write_text(config, encoding="utf-8")


def _wait(ready: Callable[[], bool], folder: Path) -> None:
    """Wait until a condition is true; the error quotes the logs of the daemons."""
    end = time.monotonic() + PATIENCE
    while not ready():
        if time.monotonic() > end:
            logs = {log.name: log.read_text(errors="replace") for log in folder.glob("*.log")}
            ends = "; ".join(f"{name}: {text.splitlines()[-1]}" for name, text in logs.items() if text)
            raise RuntimeError(f"no answer within {PATIENCE:.0f} s; {ends}")
        time.sleep(0.1)


if __name__ == "__main__":
    main()

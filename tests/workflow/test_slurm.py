"""The workflow on Slurm: a cluster of one node, started here, under the profile that we ship.

The node has a host name of its own and its cluster's configuration in the usual place (`unshare`),
as nodes have: jobs are on another machine.
"""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

from hiersched.log import log_digest

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "unshare", "setpriv")
MISSING = [name for name in PROGRAMS if shutil.which(name) is None]
if find_spec("snakemake_executor_plugin_slurm") is None:
    MISSING.append("hiersched[slurm]")

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(bool(MISSING), reason=f"not installed: {', '.join(MISSING)}"),
    pytest.mark.skipif(os.geteuid() != 0, reason="a cluster of one's own needs root"),
    pytest.mark.skipif(not Path("/etc/slurm").is_dir(), reason="no /etc/slurm to mount over"),
]

NODE = "hiersched-node"
CONFIGURATION = """
ClusterName=hiersched
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller_port}
SlurmdPort={node_port}
SlurmUser=root
SlurmdUser=root
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
NodeName={node} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory=8000
PartitionName=main Nodes={node} Default=YES State=UP
"""
TINY = """
users: {num_urllc: 2, num_embb: 2}
radio: {bandwidth_hz: 2.0e+6, num_prb: 5}
traffic: {urllc_offered_mbps: [20.0, 30.0]}
control: {max_delay_s: 0.04}
evaluate:
  {seeds: [11, 12], warmup_s: 0.0, duration_s: 1.0, full_logs: 0, policies: [pf, edf]}
sweeps:
  seeds: [21, 22]
  axes: {rayleigh_scale: null, sampling_s: null, reference: null, load: null, load_ratio: null,
         service_coefficient_mbps: null}
generalise: {cells: []}
gain_study: {methods: []}
bound: {slots_per_log: 0}
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def service(command: list[str], environment: dict[str, str], log: Path) -> Iterator[None]:
    """Run a service within the context; a kill of this process ends it too."""
    with (
        open(log, "wb") as out,
        subprocess.Popen(
            ["setpriv", "--pdeathsig", "TERM", *command],
            env=environment,
            stdout=out,
            stderr=out,
            start_new_session=True,
        ) as process,
    ):
        try:
            yield
        finally:
            process.terminate()
            process.wait(30)


def await_line(command: list[str], wanted: str, environment: dict[str, str]) -> None:
    """Wait until a command prints a word."""
    end = time.monotonic() + 60.0
    while time.monotonic() < end:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        if wanted in done.stdout:
            return
        time.sleep(0.5)
    raise AssertionError(f"{' '.join(command)}: {done.stdout}{done.stderr}")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The environment of the commands of a cluster with the partition ``main``."""
    folder = tmp_path_factory.mktemp("slurm")
    for name in ("state", "spool"):
        (folder / name).mkdir()
    key = folder / "munge.key"
    key.write_bytes(secrets.token_bytes(128))
    key.chmod(0o600)
    configuration = CONFIGURATION.format(
        host=socket.gethostname().partition(".")[0],
        controller_port=free_port(),
        node_port=free_port(),
        folder=folder,
        node=NODE,
        cpus=os.cpu_count(),
    )
    (folder / "slurm.conf").write_text(configuration, encoding="utf-8")
    environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf")}
    own = {"socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
    munge = ["munged", "--foreground", "--force", f"--key-file={key}"]
    munge += [f"--{option}={folder}/munge.{ending}" for option, ending in own.items()]
    # The executor starts srun in its jobs without SLURM_CONF.
    node = f"hostname {NODE} && mount --bind {folder} /etc/slurm && exec slurmd -D"
    with ExitStack() as services:
        for name, command in (
            ("munged", munge),
            ("slurmctld", ["slurmctld", "-D"]),
            ("slurmd", ["unshare", "--uts", "--mount", "sh", "-c", node]),
        ):
            services.enter_context(service(command, environment, folder / f"{name}.out"))
            if name == "munged":
                await_line(["ls", str(folder)], "munge.socket", environment)
        await_line(["sinfo", "--noheader", "--format=%T"], "idle", environment)
        yield environment


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A folder with a small study of two schedulers, ``tiny.yaml``."""
    (tmp_path / "tiny.yaml").write_text(TINY, encoding="utf-8")
    return tmp_path


def command(root: Path, *words: str) -> list[str]:
    workflow = root / "src/hiersched/workflow/Snakefile"
    snakemake = [sys.executable, "-m", "snakemake", "--snakefile", str(workflow)]
    return [*snakemake, *words, "--config", "scenarios=[tiny.yaml]"]


def run(folder: Path, words: list[str], environment: dict[str, str]) -> str:
    """Run Snakemake to its end; returns what it says."""
    done = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    said = done.stdout + done.stderr
    assert done.returncode == 0, said[-4000:]
    return said


def on_slurm(root: Path) -> list[str]:
    return command(root, "--profile", str(root / "profiles/slurm"))


def digests(folder: Path) -> dict[str, str]:
    """Digest of every log, text of every table."""
    results = folder / "results/tiny"
    logs = {str(p.relative_to(results)): log_digest(p) for p in results.rglob("*.mcap")}
    tables = {p.name: p.read_text(encoding="utf-8") for p in results.glob("tables/*.csv")}
    assert len(logs) == 4
    assert len(tables) > 4
    return logs | tables


def test_a_study_on_slurm_is_that_of_this_machine(
    cluster: dict[str, str], tiny: Path, project_root: Path
) -> None:
    """Every log and table; what is short shares a job; each job is done on the node."""
    environment = {**cluster, "PYTHONPATH": str(project_root / "src")}
    said = run(tiny, on_slurm(project_root), environment)
    submitted = said.count("has been submitted with SLURM jobid")
    assert 5 <= submitted <= 8, said  # not one for each of 12 tables and figures
    (tiny / "results/tiny").rename(tiny / "slurm")
    run(tiny, command(project_root, "--cores", "1"), environment)
    here = digests(tiny)
    shutil.rmtree(tiny / "results/tiny")
    (tiny / "slurm").rename(tiny / "results/tiny")
    assert digests(tiny) == here


def test_jobs_of_a_run_that_was_killed_go_on_and_keep_the_folder(
    cluster: dict[str, str], tiny: Path, project_root: Path
) -> None:
    """The next run is refused while their locks lie there; behind --unlock it goes on."""
    environment = {**cluster, "PYTHONPATH": str(project_root / "src")}
    words = on_slurm(project_root)
    killed = subprocess.Popen(
        words, cwd=tiny, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    await_line(["squeue", "--noheader", "--states=R"], "R", cluster)
    end = time.monotonic() + 60.0
    while not (tiny / ".snakemake/hiersched.elsewhere").exists():
        assert time.monotonic() < end, "no job has said that it is on another machine"
        time.sleep(0.2)
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    refused = subprocess.run(
        words, cwd=tiny, env=environment, capture_output=True, text=True, check=False
    )
    assert refused.returncode != 0
    assert "--unlock" in refused.stdout + refused.stderr
    end = time.monotonic() + 120.0
    while subprocess.run(
        ["squeue", "--noheader"], env=cluster, capture_output=True, check=True
    ).stdout:
        assert time.monotonic() < end
        time.sleep(0.5)
    run(tiny, command(project_root, "--unlock"), environment)
    run(tiny, words, environment)
    assert len(digests(tiny)) > 8

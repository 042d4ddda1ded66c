"""What is in `launch/`: as far as it can be checked without the platform that each is for."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from apex_bat.config import load

ROOT = Path(__file__).parents[3]
LAUNCH = ROOT / "launch"
SCRIPTS = ("slurm.sbatch", "hosts.sh")
DESCRIPTIONS = (*SCRIPTS, "ray-cluster.yaml", "rayjob.yaml")
BASH = shutil.which("bash") or ""
needs_bash = pytest.mark.skipif(not BASH, reason="no bash")


def text(name: str) -> str:
    return (LAUNCH / name).read_text(encoding="utf-8")


def parsed(name: str) -> dict[str, Any]:
    yaml = pytest.importorskip("yaml")
    content = yaml.safe_load(text(name))
    assert isinstance(content, dict)
    return content


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_each_description_marks_the_lines_to_edit_and_sets_the_token(name: str) -> None:
    edited = [line for line in text(name).splitlines() if "EDIT" in line]
    assert 4 <= len(edited) <= 12
    assert "token" in text(name)


@pytest.mark.parametrize("name", [name for name in DESCRIPTIONS if name != "rayjob.yaml"])
def test_rays_dashboard_stays_on_loopback(name: str) -> None:
    assert "0.0.0.0" not in text(name)  # noqa: S104
    assert "--dashboard-host=127.0.0.1" in text(name) or "--include-dashboard=false" in text(name)


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_the_training_that_each_starts_has_settings_that_exist(name: str) -> None:
    words = shlex.split(text(name).replace("(", " ").replace(")", " "), comments=True)
    settings = [words[i + 1] for i, word in enumerate(words) if word == "--set"]
    if name == "ray-cluster.yaml":  # it starts Ray only; how training is started stands in a comment
        assert "--set actors=auto" in text(name)
        return
    assert settings or "--set actors=auto" in text(name)
    load(None, settings, lambda _: 3)


@needs_bash
@pytest.mark.parametrize("script", [LAUNCH / "slurm.sbatch", LAUNCH / "hosts.sh", ROOT / "benchmarks/cluster_netns.sh"])
def test_scripts_are_bash(script: Path) -> None:
    checked = subprocess.run([BASH, "-n", str(script)], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr


def test_ray_up_takes_its_description_and_would_notice_a_wrong_key() -> None:
    util = pytest.importorskip("ray.autoscaler._private.util")
    content = parsed("ray-cluster.yaml")
    util.validate_config(util.prepare_config(dict(content)))
    assert content["max_workers"] == content["min_workers"] == len(content["provider"]["worker_ips"])
    with pytest.raises(Exception, match="head_strat"):
        util.validate_config(util.prepare_config(content | {"head_strat_ray_commands": []}))


def test_the_job_of_kuberay_is_whole() -> None:
    """Its schema (KubeRay's own, v1 of RayJob) was checked by hand; here that what it names is there."""
    content = parsed("rayjob.yaml")
    assert (content["apiVersion"], content["kind"]) == ("ray.io/v1", "RayJob")
    cluster = content["spec"]["rayClusterSpec"]
    assert cluster["authOptions"] == {"mode": "token"}
    constraints = (ROOT / "constraints.txt").read_text(encoding="utf-8").split()
    assert f"ray=={cluster['rayVersion']}" in constraints
    for group in (cluster["headGroupSpec"], *cluster["workerGroupSpecs"]):
        pod = group["template"]["spec"]
        (container,) = pod["containers"]
        mounts = {mount["name"]: mount["mountPath"] for mount in container["volumeMounts"]}
        assert mounts == {"shared": "/shared"}
        assert [volume["name"] for volume in pod["volumes"]] == ["shared"]
    words = shlex.split(content["spec"]["entrypoint"])
    assert words[:4] == ["apex-bat", "train", "--cluster", "auto"]
    assert words[words.index("--run") + 1].startswith("/shared/")


@needs_bash
def test_hosts_are_entered_in_order_and_the_token_is_in_no_command_line(tmp_path: Path) -> None:
    assert not hosts_up(tmp_path)
    calls = (tmp_path / "calls").read_text()
    order = [line.split("--")[0].split()[-1] for line in calls.splitlines() if "BatchMode" in line]
    assert order == ["a", "b", "c", "a", "b", "c"]
    tokens = [(tmp_path / f"home-{host}/.ray/auth_token").read_text() for host in "abc"]
    assert len(set(tokens)) == 1
    assert len(tokens[0]) == 64
    assert tokens[0] not in calls
    assert (tmp_path / "home-b/.ray/auth_token").stat().st_mode & 0o777 == 0o600
    assert "ray start --head" in calls
    assert "ray start --address=" in calls


@needs_bash
def test_a_token_that_the_head_has_is_kept_and_given_to_the_others(tmp_path: Path) -> None:
    token = tmp_path / "home-a" / ".ray" / "auth_token"
    token.parent.mkdir(parents=True)
    token.write_text("of a cluster that runs")
    hosts_up(tmp_path)
    assert token.read_text() == "of a cluster that runs"
    assert (tmp_path / "home-c/.ray/auth_token").read_text() == "of a cluster that runs"


@needs_bash
def test_a_dry_run_shows_every_command_and_runs_none(tmp_path: Path) -> None:
    said = hosts_up(tmp_path, DRY="1")
    assert said.count("ssh ") == 6
    assert not (tmp_path / "calls").exists()


def hosts_up(folder: Path, **more: str) -> str:
    """Runs `hosts.sh up`, each host a home folder here; returns what it says."""
    run = f'mkdir -p {folder}/home-$3; case "$5" in umask*) HOME={folder}/home-$3 exec bash -c "$5";; esac'
    _fake(folder, "ssh", f'echo "$@" >> {folder}/calls; {run}')
    environment = os.environ | {"PATH": f"{folder}:{os.environ['PATH']}", "HEAD": "a", "WORKERS": "b c"} | more
    command = [BASH, str(LAUNCH / "hosts.sh"), "up"]
    return subprocess.run(command, env=environment, check=True, timeout=30, capture_output=True, text=True).stdout


@needs_bash
@pytest.mark.parametrize(("training", "code"), [("exit 7", 7), ("exit 0", 0)])
def test_a_slurm_job_ends_with_the_code_of_the_training_and_leaves_no_token(
    training: str, code: int, tmp_path: Path
) -> None:
    process = _slurm(tmp_path, training)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == code, output
    assert not list(tmp_path.glob("shared/.token-*"))
    assert (tmp_path / "workers").read_text().count("ray start --block --address=127.0.0.1:") == 2


@needs_bash
def test_a_slurm_job_that_is_about_to_end_lets_the_training_save(tmp_path: Path) -> None:
    process = _slurm(tmp_path, "trap 'echo saved; exit 130' TERM; echo begun >&2; while :; do sleep 0.1; done")
    assert process.stderr is not None
    while "begun" not in (line := process.stderr.readline()):
        assert line, "the training begins"
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=60)
    assert "saved" in output
    assert process.returncode == 130


def test_the_script_beside_them_is_the_same_as_the_command() -> None:
    def said(*words: str) -> tuple[int, str]:
        ran = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False, cwd=ROOT)
        return ran.returncode, ran.stderr.rpartition("Error:")[2]

    script = said("launch/ray_cluster.py", "--serial")
    assert script == said("-m", "apex_bat", "train", "--cluster", "auto", "--serial")
    assert script[0] == 2
    assert "--serial runs all roles in this process" in " ".join(script[1].replace("│", " ").split())


def _slurm(folder: Path, training: str) -> subprocess.Popen[str]:
    """Starts the batch script among commands that pretend to be Slurm, Ray and the training."""
    with socket.socket() as one:  # a port of those that the script takes: 20000 and the job's number
        for port in range(20_000, 30_000):
            try:
                one.bind(("127.0.0.1", port))
                break
            except OSError:
                continue
        port = one.getsockname()[1]
    listen = f"import socket, time; s = socket.create_server(('127.0.0.1', {port})); time.sleep(60)"
    _fake(folder, "scontrol", "printf 'a\\nb\\nc\\n'")
    (folder / "workers").touch()
    _fake(folder, "apex-bat", f'while [ "$(wc -l <{folder}/workers)" -lt 2 ]; do sleep 0.05; done; {training}')
    _fake(
        folder,
        "srun",
        'case "$*" in *hostname*) echo 127.0.0.1;; '
        f'*--head*) exec {sys.executable} -c "{listen}";; '
        f'*) echo "$@" >> {folder}/workers; exec sleep 60;; esac',
    )
    environment = os.environ | {
        "PATH": f"{folder}:{os.environ['PATH']}", "VENV": str(folder), "SHARED": str(folder / "shared"),
        "SLURM_JOB_ID": str(port - 20_000), "SLURM_JOB_NODELIST": "a,b,c", "SLURM_CPUS_PER_TASK": "4",
    }  # fmt: skip
    (folder / "bin").symlink_to(folder)
    return subprocess.Popen(
        [BASH, str(LAUNCH / "slurm.sbatch")], env=environment, cwd=ROOT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def _fake(folder: Path, name: str, script: str) -> None:
    path = folder / name
    path.write_text(f"#!/usr/bin/env bash\n{script}\n")
    path.chmod(0o755)

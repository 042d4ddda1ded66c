"""The command line: what a user types wrong, and what is said of it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from apex_bat.cli import main
from tests.cli.conftest import Command, Refused


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (["train", "--set", "replay.capcity=5"], 2, "replay.capcity: no such setting; did you mean replay.capacity?"),
        (["train", "--set", "seed=one"], 2, "seed: expected `int`, got `str`"),
        (["train", "--config", "nowhere.toml"], 2, "nowhere.toml: no such file"),
        (["train", "--set", "arena=labyrinth"], 2, "labyrinth: no such arena; there are circle, "),
        (["train", "--set", "network.strides=[20, 9]"], 2, "leave nothing of a row"),
        (["train", "--set", "transport.host=0.0.0.0"], 1, "not a loopback address, so it needs CURVE keys"),
        (["train", "--set", "transport.keys=nowhere"], 1, "nowhere"),
        (["train", "--serial", "--set", "replay.shards=2"], 2, "replay.shards is 2, and a serial run has one replay"),
        (["train", "--set", "replay.error_buffer=9"], 2, "replay.error_buffer 9 is too narrow"),
        (["train", "--set", "replay.capacity=600", "--set", "replay.min_size=100"], 2, "less than the 848 transitions"),
        (
            ["train", "--set", "replay.shards=4", "--set", "replay.capacity=3000"],
            2,
            "replay.capacity 3000, 750 at each of 4 servers, is less than the 848 transitions",
        ),
        (
            ["train", "--set", "replay.shards=2", "--set", "replay.error_buffer=90"],
            2,
            "replay.error_buffer 90 is too narrow, shared out over 2 servers",
        ),
        (
            ["train", "--set", "transport.max_message_mb=0.1", "--set", "network.hidden=[8]"],
            2,
            "less than the 0.83 MB",
        ),
        (
            ["train", "--set", "transport.max_message_mb=0.9"],
            2,
            "less than the 0.971 MB that weights of 250468 parameters",
        ),
        (
            [
                "evaluate",
                "--policy",
                "straight",
                "--flights",
                "1",
                "--arenas",
                "simple",
                "--set",
                "rays.num_azimuth=4",
                "--set",
                "episode.evaluation_steps=2",
                "--json",
                "/nowhere/file.json",
            ],
            1,
            "/nowhere/file.json: No such file",
        ),
        (["train", "--nonsense"], 2, "No such option"),
        (["train", "--resume", "nowhere"], 1, "nowhere: no run here"),
        (["train", "--resume", "nowhere", "--run", "somewhere"], 2, "give one of them"),
        (["train", "--without-replay"], 2, "belongs to --resume"),
        (["train", "--serial", "--set", "device=cuda"], 2, "the serial mode promises equal bits"),
        (["evaluate", "nowhere"], 1, "nowhere: no run here"),
        (["inspect", "nowhere"], 1, "nowhere"),
        (["status", "nowhere"], 1, "no run was started here"),
        (["arena", "labyrinth"], 2, "no such arena"),
        (["bench", "nothing"], 2, "bench nothing: no such part; there are simulation, "),
    ],
)
def test_wrong_usage_is_one_clear_line_and_the_right_exit_code(
    arguments: list[str], code: int, says: str, refused: Refused
) -> None:
    refused(arguments, code, says)


def test_an_unwritable_run_folder_is_named(command: Command, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    code, error = command(["train", "--run", str(tmp_path / "file" / "run")])
    assert code == 1
    assert "the run folder cannot be written" in error


def test_an_arena_without_safe_start_is_refused(command: Command, tmp_path: Path) -> None:
    walls = [
        [x, y, yaw, 1.0, 0.15, 1.0] for x, y, yaw in ((0, 0.5, 0), (0, -0.5, 0), (0.5, 0, 1.5708), (-0.5, 0, 1.5708))
    ]
    path = tmp_path / "cell.toml"
    path.write_text(f'name = "cell"\nstart = [0.0, 0.0]\nwalls = {json.dumps(walls)}\n')
    code, error = command(["train", "--set", f"arena={path}"])
    assert code == 2
    assert "cell" in error
    assert "start" in error


COMMANDS = (
    "train",
    "evaluate",
    "reproduce",
    "inspect",
    "status",
    "arena",
    "bench",
    "keys",
    "actor",
    "replay",
    "learner",
    "evaluator",
)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["apex-bat", command, "--help"])
    assert main() == 0
    assert "Usage: " in capsys.readouterr().out


def test_keys_are_made_once_and_only_for_their_owner(command: Command, tmp_path: Path) -> None:
    folder = tmp_path / "keys"
    assert command(["keys", str(folder)])[0] == 0
    assert all(path.stat().st_mode & 0o077 == 0 for path in folder.iterdir())
    code, error = command(["keys", str(folder)])
    assert code == 1
    assert str(folder) in error


def imports_of(script: str) -> set[str]:
    """Returns the modules that a fresh interpreter holds after a script."""
    command = [sys.executable, "-c", f"import sys; {script}; print('MODULES', *sys.modules)"]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return set(output.rpartition("MODULES")[2].split())


def test_help_needs_nothing_heavy() -> None:
    modules = imports_of("from apex_bat.cli import main; sys.argv = ['apex-bat', '--help']; main()")
    assert not modules & {"torch", "pybullet", "ray", "rerun", "numpy", "zmq", "gymnasium"}


def test_a_replay_host_needs_neither_torch_nor_pybullet() -> None:
    modules = imports_of("import apex_bat.roles.process, apex_bat.roles.replay")
    assert not modules & {"torch", "pybullet", "ray", "rerun", "gymnasium", "scipy"}


def test_an_actor_needs_no_torch() -> None:
    assert "torch" not in imports_of("import apex_bat.roles.actor, apex_bat.roles.evaluator")


def test_python_m_is_the_same_program(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "apex_bat", "--version"]
    output = subprocess.run(command, check=True, capture_output=True, text=True, env=os.environ, cwd=tmp_path).stdout
    assert output.startswith("apex-bat ")


def test_a_further_client_gets_a_folder_of_its_own(command: Command, tmp_path: Path) -> None:
    assert command(["keys", str(tmp_path / "keys")])[0] == 0
    assert command(["keys", str(tmp_path / "keys"), "--client", str(tmp_path / "b")])[0] == 0
    assert not (tmp_path / "b" / "server.secret").exists()
    assert len((tmp_path / "keys" / "allowed_clients").read_text().split()) == 2

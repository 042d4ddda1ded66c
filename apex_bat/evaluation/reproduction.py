"""A campaign: every condition trained from every seed with the same budget, one run after the other, then judged.

The folder of a campaign holds `campaign.json`, a run folder CONDITION-SEED for each training, `baselines/` and
`report/`. Seeds come one after the other and the conditions within each, so that a campaign that is cut short is
balanced. What is finished is not made again; a training that was cut off, also by SIGKILL, is begun anew in its
folder's place, because one that ran without a break is easier to trust.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from datetime import datetime
from fnmatch import fnmatch
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec
import numpy as np

from apex_bat.config import Config, ConfigError
from apex_bat.config.loading import differences
from apex_bat.config.settings import Train
from apex_bat.evaluation import runs
from apex_bat.evaluation.groups import CONDITIONS
from apex_bat.evaluation.results import Judged, Protocol, judge, judge_baselines
from apex_bat.storage import StorageError, read_json, write_text

CAMPAIGN = "campaign.json"
MAY_DIFFER = (
    "seed", "condition", "device", "launch.*", "recording.*", "transport.*", "train.threads",
    "replay.snapshot_period_s",
)  # fmt: skip
"""Settings that may change when a campaign goes on: they make its runs no less comparable."""

Standing = Literal["absent", "cut", "trained"]
Say = Callable[[str], None]


class Planned(NamedTuple):
    """One training of a campaign."""

    condition: str
    seed: int
    folder: Path
    config: Config

    @property
    def standing(self) -> Standing:
        """Whether it is made, was begun and not finished, or neither."""
        path = self.folder / "run.json"
        if not path.exists():
            return "cut" if self.folder.exists() else "absent"
        try:
            return "trained" if read_json(path).get("outcome") == "completed" else "cut"
        except StorageError:
            return "cut"


def plan(folder: Path, config: Config, conditions: Sequence[str], num_seeds: int, budget: int) -> list[Planned]:
    """Returns the trainings of a campaign in their order: for each seed all conditions.

    Args:
        folder: of the campaign.
        config: settings of all runs; its seed is the first one.
        conditions: which to train.
        num_seeds: how many seeds.
        budget: environment steps of each training.

    Raises:
        ConfigError: a condition that does not exist or is named twice, or settings with which budgets would differ.
    """
    for name in conditions:
        if name not in CONDITIONS:
            raise ConfigError(f"--conditions {name}: no such condition; there are {', '.join(CONDITIONS)}")
    if not conditions or len(set(conditions)) < len(conditions):
        raise ConfigError("--conditions: name at least one condition, and each once")
    if config.replay.never_block:
        raise ConfigError("replay.never_block lets the machine choose the samples per insert; conditions need the same")
    train = Train(max_minutes=None, max_env_steps=budget, threads=config.train.threads)
    planned = []
    for seed in range(config.seed, config.seed + num_seeds):
        for condition in conditions:
            own = msgspec.structs.replace(config, condition=condition, seed=seed, train=train)
            planned.append(Planned(condition, seed, folder / f"{condition}-{seed}", own))
    return planned


def refuse_limits(overrides: Sequence[str]) -> None:
    """Refuses limits of a training, which the budget of the campaign would replace without a word.

    Raises:
        ConfigError: an override sets one.
    """
    for override in overrides:
        if override.partition("=")[0].strip() in ("train.max_minutes", "train.max_env_steps", "train.max_updates"):
            raise ConfigError(f"--set {override}: trainings of a campaign end by --budget alone, in environment steps")


def begin(folder: Path, planned: Sequence[Planned]) -> None:
    """Makes the folder of a campaign, or checks that it is one of the same settings.

    More seeds and conditions may be asked for later; other settings, or another budget, may not.

    Raises:
        ConfigError: the folder holds a campaign of other settings.
        RunError: the folder cannot be written, or holds something else.
    """
    path = folder / CAMPAIGN
    try:
        if path.exists():
            _compare(folder, read_json(path).get("settings"), planned[0].config)
            return
        if folder.exists() and any(folder.iterdir()):
            raise runs.RunError(f"{folder}: holds something that is no campaign; name another folder with --folder")
        folder.mkdir(parents=True, exist_ok=True)
        write_text(path, json.dumps({"settings": msgspec.to_builtins(planned[0].config)}, indent=1) + "\n")
    except (OSError, StorageError) as error:
        raise runs.RunError(f"{folder}: the folder of the campaign cannot be used: {error}") from None


def _compare(folder: Path, settings: object, config: Config) -> None:
    """Refuses settings other than those that a campaign began with; settings that are newer had their defaults."""
    try:
        begun = msgspec.convert(settings, Config)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{folder}: its settings are none of this version ({error}); name another folder") from None
    apart = [
        line
        for line in differences(begun, config)
        if not any(fnmatch(line.partition(":")[0], pattern) for pattern in MAY_DIFFER)
    ]
    if apart:
        raise ConfigError(
            f"{folder}: holds a campaign of other settings (begun | asked for: {'; '.join(apart)}); name another "
            "folder with --folder"
        )


def train_all(planned: Sequence[Planned], train: Callable[[Planned, str], bool], say: Say) -> bool:
    """Makes every training that is not made yet.

    Args:
        planned: in order.
        train: makes one, under a title, in a folder that is absent or to be emptied (`clear`); returns False when it
            was interrupted.
        say: tells a line.

    Returns:
        False if one was interrupted; the same call goes on.
    """
    for number, each in enumerate(planned, 1):
        where = f"run {number} of {len(planned)}: {each.condition}, seed {each.seed}"
        if each.standing == "trained":
            say(f"{where}: is there")
            continue
        if each.standing == "cut":
            say(f"{where}: was cut off and begins anew")
        if not train(each, f"{where}{_time_left(planned, number)}"):
            return False
    return True


def clear(folder: Path) -> None:
    """Empties the folder of a training that was cut off. Whoever calls this holds the lock of the folder."""
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def judge_all(
    folders: Sequence[Path], baselines: Path, protocol: Protocol, say: Say
) -> tuple[list[Judged], list[Judged]]:
    """Flies what was trained, and the baselines, as far as that was not done before, and returns both.

    Args:
        folders: of the runs; at least one, and each once. The baselines fly with body, rays and ear of the first.
        baselines: folder for the flights of the baselines.
        protocol: how all fly.
        say: tells a line.

    Raises:
        RunError, StorageError: a run is given twice, or something cannot be read or written.
    """
    resolved = [folder.resolve() for folder in folders]
    twice = [str(folder) for number, folder in enumerate(folders) if resolved[number] in resolved[:number]]
    if twice:
        raise runs.RunError(f"{', '.join(twice)}: given twice, and one run is one piece of evidence")
    judged = []
    for number, folder in enumerate(folders, 1):
        say(f"flying {folder.name}, {number} of {len(folders)}, {protocol.num_flights} times in each arena")
        judged.append(judge(folder, protocol))
    say("flying the baselines")
    return judged, judge_baselines(judged[0].config, baselines, protocol)


def _time_left(planned: Sequence[Planned], number: int) -> str:
    """Returns how long this run and those after it will take if they take as long as those that are made."""
    took_s = [taken for each in planned if (taken := _took_s(each)) is not None]
    if not took_s:
        return ""
    num_left = sum(each.standing != "trained" for each in planned[number - 1 :])
    minutes = num_left * float(np.mean(took_s)) / 60.0
    return f", about {minutes / 60.0:.1f} h left" if minutes > 90.0 else f", about {minutes:.0f} min left"


def _took_s(each: Planned) -> float | None:
    if each.standing != "trained":
        return None
    facts = read_json(each.folder / "run.json")
    try:
        return (datetime.fromisoformat(facts["end"]) - datetime.fromisoformat(facts["start"])).total_seconds()
    except (KeyError, TypeError, ValueError):
        return None

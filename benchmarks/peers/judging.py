"""How many of 15 flights a policy completes: those of `apex-bat evaluate`, from its starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from apex_bat.agent.inference import Policy
from apex_bat.config import Config, settings
from apex_bat.roles import checkpoint

Parameters = Mapping[str, NDArray[np.float32]]


class Judgement(NamedTuple):
    """What the flights of a policy came to."""

    completed: int
    """Flights of 1000 steps that touched no wall."""
    progress_m: float
    """Mean net way along the corridor: a bat that circles on the spot completes flights, too, but makes none."""


def judge(parameters: Parameters, config: Config) -> Judgement:
    """Returns how many flights a policy completes, and how far it comes.

    Args:
        parameters: by the names of `apex_bat.agent.inference`; the dense layers may have other widths.
        config: says how many flights, where, and from which starts.
    """
    from apex_bat.evaluation.flights import fly  # here: a training process judges nothing

    policy = Policy(fitting(config.network, parameters), config.state_steps)
    policy.load(dict(parameters))
    records, _ = fly(
        policy, config, config.arena, num_flights=config.evaluation.flights, seed=config.evaluation.start_seed
    )
    progress_m = sum(record.progress_m for record in records) / len(records)
    return Judgement(sum(record.completed for record in records), progress_m)


@contextmanager
def judges(config: Config, processes: int) -> Iterator[Callable[[Sequence[Path]], list[Judgement]]]:
    """Gives what judges the policies in some files, by several processes at once."""
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        yield lambda paths: list(pool.map(_judge_file, paths, [config] * len(paths)))


def judge_course(
    files: Mapping[float, Path],
    enough: int,
    later_s: float,
    judge_all: Callable[[Sequence[Path]], Sequence[Judgement]],
    together: int,
) -> dict[float, Judgement]:
    """Returns how the policies of a training were judged, by their times.

    Every policy is judged until one completes enough, which is what the contest asks for; of those after it only one
    in a while, and the last, for a judgement of good policies takes several seconds.

    Args:
        files: by the time of each policy, ascending.
        enough: flights.
        later_s: least time between policies that are judged after one completed enough.
        judge_all: judges some files.
        together: how many are judged at once.
    """
    times, judged = list(files), dict[float, Judgement]()
    waiting = times
    while waiting and max((each.completed for each in judged.values()), default=0) < enough:
        some, waiting = waiting[:together], waiting[together:]
        judged |= zip(some, judge_all([files[time_s] for time_s in some]), strict=True)
    chosen: list[float] = []
    for time_s in waiting:
        if time_s - max((*chosen, *judged)) >= later_s or time_s == times[-1]:
            chosen.append(time_s)
    return judged | dict(zip(chosen, judge_all([files[time_s] for time_s in chosen]), strict=True))


def parameters_in(path: Path) -> dict[str, NDArray[np.float32]]:
    """Returns the parameters in a checkpoint of apex_bat, or in a file of the notebook."""
    if path.name.startswith("step-"):
        return checkpoint.load(path).policy_parameters()
    with np.load(path, allow_pickle=False) as arrays:
        return {name: np.asarray(arrays[name]) for name in arrays.files}


def fitting(network: settings.Network, parameters: Parameters) -> settings.Network:
    """Returns the settings of a network whose dense layers are as wide as these parameters."""
    numbers = sorted(int(name.split(".")[1]) for name in parameters if name.startswith("value.") and "bias" in name)
    widths = tuple(len(parameters[f"value.{number}.bias"]) for number in numbers[:-1])
    return msgspec.structs.replace(network, hidden=widths)


def _judge_file(path: Path, config: Config) -> Judgement:
    return judge(parameters_in(path), config)

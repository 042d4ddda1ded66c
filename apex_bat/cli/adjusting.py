"""`apex-bat adjust`: what can be changed while a run goes on."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from apex_bat.config import ConfigError

if TYPE_CHECKING:
    from apex_bat.transport.messages import Ratio


def adjust(
    run: Annotated[Path, typer.Argument(help="Run folder of a run that is going on.")],
    samples_per_insert: Annotated[float, typer.Option(help="How often each transition is sampled, from now on.")],
    error_buffer: Annotated[
        float | None,
        typer.Option(help="Half-width of the band, in samples. [default: the setting, as wide as the ratio needs]"),
    ] = None,
) -> None:
    """Change the replay's samples per insert while a run goes on; snapshots keep it, and run.json notes it."""
    from apex_bat.evaluation import runs
    from apex_bat.replay.adjusting import change_ratio
    from apex_bat.roles.plan import Role, read_addresses
    from apex_bat.roles.process import ADDRESSES
    from apex_bat.transport.messages import RatioChange
    from apex_bat.transport.security import TransportError, load_keys

    if not 0.0 < samples_per_insert <= 1e6 or (error_buffer is not None and not 0.0 <= error_buffer <= 1e12):
        raise ConfigError("--samples-per-insert must be above 0 and at most 1e6, --error-buffer 0 to 1e12")
    config = runs.load_config(run)
    addresses = read_addresses(run / ADDRESSES)
    keys = load_keys(Path(config.transport.keys)) if config.transport.keys else None
    shards = config.replay.shards
    change = RatioChange(samples_per_insert, None if error_buffer is None else error_buffer / shards)
    changed: dict[str, Ratio] = {}
    for number, (address, generation) in enumerate(zip(addresses.replays, addresses.replay_generations, strict=True)):
        name = Role("replay", number, shards).name
        try:
            now = change_ratio(address, change, generation=generation, keys=keys)
        except (TransportError, ValueError) as error:
            if changed:
                _note(run, shards, changed)
            kind = TransportError if isinstance(error, TransportError) else ConfigError
            raise kind(_failure(name, error, list(changed))) from None
        changed[name] = now
    _note(run, shards, changed)
    print(f"samples per insert is now {now.samples_per_insert:g}, within {shards * now.error_buffer:g} samples")


def _failure(name: str, error: Exception, changed: list[str]) -> str:
    """Returns what is said of a server that did not change its law, and of those that had done so before."""
    if not changed:
        return str(error)
    return (
        f"{name}: {error}; {', '.join(changed)} {'has' if len(changed) == 1 else 'have'} the new law, the others the "
        f"former one: give the command again, with this ratio or the former one, when {name} can take it"
    )


def _note(run: Path, shards: int, changed: dict[str, Ratio]) -> None:
    """Notes a change in run.json: the law of all servers together, and which have it if not all do."""
    from apex_bat.evaluation import runs
    from apex_bat.storage import read_json

    law = next(iter(changed.values()))
    entry: dict[str, object] = {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "samples_per_insert": law.samples_per_insert,
        "error_buffer": shards * law.error_buffer,
    }
    if len(changed) < shards:
        entry["servers"] = list(changed)
    runs.note(run, adjusted=[*read_json(run / "run.json").get("adjusted", []), entry])

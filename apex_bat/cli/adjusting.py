"""`apex-bat adjust`: what can be changed while a run goes on."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from apex_bat.config import ConfigError


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
    from apex_bat.roles.plan import read_addresses
    from apex_bat.roles.process import ADDRESSES
    from apex_bat.storage import read_json
    from apex_bat.transport.messages import Ratio, RatioChange
    from apex_bat.transport.security import load_keys

    if not 0.0 < samples_per_insert <= 1e6 or (error_buffer is not None and not 0.0 <= error_buffer <= 1e12):
        raise ConfigError("--samples-per-insert must be above 0 and at most 1e6, --error-buffer 0 to 1e12")
    config = runs.load_config(run)
    addresses = read_addresses(run / ADDRESSES)
    keys = load_keys(Path(config.transport.keys)) if config.transport.keys else None
    shards = config.replay.shards
    change = RatioChange(samples_per_insert, None if error_buffer is None else error_buffer / shards)
    try:
        for address, generation in zip(addresses.replays, addresses.replay_generations, strict=True):
            now = change_ratio(address, change, generation=generation, keys=keys)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    now = Ratio(now.samples_per_insert, shards * now.error_buffer)
    moment = datetime.now(UTC).isoformat(timespec="seconds")
    entry = {"time": moment, "samples_per_insert": now.samples_per_insert, "error_buffer": now.error_buffer}
    runs.note(run, adjusted=[*read_json(run / "run.json").get("adjusted", []), entry])
    print(f"samples per insert is now {now.samples_per_insert:g}, within {now.error_buffer:g} samples")

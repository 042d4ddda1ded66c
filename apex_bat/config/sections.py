"""What a table of settings is, and the ranges that many of them share."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

Condition = Literal["memory", "no_memory", "onset"]

Positive = Annotated[float, Meta(gt=0.0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Count = Annotated[int, Meta(ge=1)]
CountOrZero = Annotated[int, Meta(ge=0)]


class Section(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the configuration file; unknown keys are refused."""

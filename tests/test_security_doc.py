"""The figures of docs/security.md are those of the committed measurement, and keep what it promises."""

import json
from pathlib import Path

import pytest

from benchmarks.attacks import CONNECTIONS, ON_REPLAY, ON_REPORTS, ON_WEIGHTS
from benchmarks.hostile import Record, table

ROOT = Path(__file__).parents[1]
DOC = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
RECORDS: list[Record] = json.loads((ROOT / "docs" / "results" / "hostile.json").read_text(encoding="utf-8"))
STRANGERS = {
    *CONNECTIONS,
    "oversized",
    "foreign bytes",
    "unknown generation",
    "requests of a stranger",
    "subscriptions of a stranger",
}
CASES = {(str(record["socket"]), str(record["attack"])): record for record in RECORDS}


def test_the_table_is_that_of_the_result() -> None:
    assert table(RECORDS) in DOC


def test_every_attack_on_every_socket_is_measured() -> None:
    attacks = {"replay": ON_REPLAY, "weights": ON_WEIGHTS, "reports": ON_REPORTS}
    assert set(CASES) == {(socket, attack) for socket, made in attacks.items() for attack in made}


@pytest.mark.parametrize("case", sorted(CASES), ids=" ".join)
def test_no_stranger_takes_a_tenth_of_a_core_from_the_server_and_no_insider_a_fifth(case: tuple[str, str]) -> None:
    assert float(CASES[case]["cpu_share"]) < (0.1 if case[1] in STRANGERS else 0.2)

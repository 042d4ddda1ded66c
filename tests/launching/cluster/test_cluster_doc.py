"""The page on clusters says what was measured, and names what exists."""

import json
import re
from pathlib import Path

from apex_bat.config import Config
from apex_bat.config.loading import dumps
from benchmarks.cluster_faults import BEGIN, END, HEAD_LOST, TARGET_S, table

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")
RESULT = json.loads((ROOT / "docs" / "results" / "cluster.json").read_text(encoding="utf-8"))


def test_the_table_of_faults_is_that_of_the_result() -> None:
    assert PAGE.partition(BEGIN)[2].partition(END)[0].strip() == table(RESULT).strip()


def test_every_fault_was_measured_and_a_role_that_was_cut_off_ended_within_its_lease() -> None:
    assert {one["fault"] for one in RESULT["faults"]} == {*TARGET_S, HEAD_LOST}
    cut = [one for one in RESULT["faults"] if one["fault"].startswith("cut off")]
    assert all(one["old_ended_s"] <= one["lease_s"] < one["recovered_s"] for one in cut)
    assert all(one["from_host"] != one["to_host"] for one in cut)


def test_every_role_worked_again_within_its_target() -> None:
    late = {
        one["fault"]: one["recovered_s"]
        for one in RESULT["faults"]
        if one["recovered_s"] > TARGET_S.get(one["fault"], 60.0)
    }
    assert not late


def test_the_training_across_hosts_is_that_of_the_result() -> None:
    result = json.loads((ROOT / "docs" / "results" / "cluster_training.json").read_text(encoding="utf-8"))
    training, text = result["training"], " ".join(PAGE.split())
    assert (
        f"{training['env_steps']:,} steps and {training['learner_steps']:,} updates in {result['minutes']} minutes"
        in text
    )
    simple, narrow, circle = (row["completed"] for row in result["summary"])
    assert f"completes {simple} of 15 flights in simple, {narrow} in narrow and {circle} in circle" in text
    assert result["hosts"]["replay"] != result["hosts"]["learner"]
    assert result["hosts"]["actor-0"] != result["hosts"]["actor-1"]


def test_settings_and_files_that_the_page_names_exist() -> None:
    settings = set(re.findall(r"(?<![-_/a-z])cluster[.]([a-z_]+)", PAGE))
    assert settings <= set(Config().cluster.__struct_fields__)
    assert dumps(Config()).count("[cluster]") == 1
    for name in re.findall(r"`(launch/[^` ]+|benchmarks/[^` ]+)`", PAGE):
        assert (ROOT / name).is_file(), name

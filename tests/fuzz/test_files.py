"""Whatever a file holds, its loader reads it or raises its own error, within the memory that the file has."""

from __future__ import annotations

import io
import logging
import time
import tracemalloc
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from apex_bat.config import ConfigError, load
from apex_bat.simulation.arenas import load_arena
from apex_bat.simulation.layout import MAX_AREA_M2, ArenaError
from apex_bat.storage import StorageError, read_json, read_npz
from tests.fuzz.fuzz_files import fuzz, take, targets

CORPUS = sorted((Path(__file__).parent / "corpus" / "files").iterdir())
NAMES = [
    *("addresses", "arena", "arrays", "best", "checkpoint", "config", "keys", "member", "metrics", "override"),
    *("packed", "run", "snapshot", "snapshot_header", "status"),
]
PIECES = st.one_of(
    st.binary(max_size=8),
    st.sampled_from(
        [b"1e999", b"-1", b"null", b"[]", b"{}", b'"x"', b"9" * 5000, b"[" * 3000, b"NaN", b"\x00", b"'O'"]
    ),
)


@pytest.fixture(autouse=True, scope="module")
def quiet() -> Iterator[None]:
    """Keeps thousands of warnings about bad files out of the report."""
    logging.disable(logging.ERROR)
    yield
    logging.disable(logging.NOTSET)


def test_every_loader_is_named_here() -> None:
    assert sorted(targets()) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_loader_reads_what_it_should(name: str) -> None:
    target = targets()[name]
    target.read(target.seed)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_a_damaged_file_is_read_or_refused(name: str, data: st.DataObject) -> None:
    content = bytearray(targets()[name].seed)
    for _ in range(data.draw(st.integers(1, 4))):
        begin = data.draw(st.integers(0, len(content)))
        end = min(len(content), begin + data.draw(st.integers(0, 12)))
        content[begin:end] = data.draw(PIECES)
    take(name, bytes(content[: data.draw(st.one_of(st.just(len(content)), st.integers(0, len(content))))]))


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=15, deadline=None)
@given(content=st.one_of(st.binary(max_size=200), PIECES))
def test_any_bytes_are_read_or_refused(name: str, content: bytes) -> None:
    take(name, content)


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.name)
def test_the_corpus_of_the_fuzzer_is_taken_as_documented(path: Path) -> None:
    fuzz(path.read_bytes())


def npy(shape: str, descr: str = "'<f8'", data: bytes = b"") -> bytes:
    """An array's file with any claim in its header."""
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


@pytest.mark.parametrize(
    "content",
    [
        npy("(1000000000000,)"),
        npy("(1000000, 1000000, 1000000)"),
        npy("(-1, -8)", data=bytes(64)),
        npy("(1000000000000,)", "'S0'"),
        npy("(0, 100000000000000000000000)"),
        npy("(1,)", "'U1000000000'"),
        npy("(1,)", "'O'", bytes(8)),
        npy("(1,)", "[('a', '<f8')]", bytes(8)),
    ],
    ids=["huge", "overflowing", "negative", "of nothing", "empty and huge", "long text", "objects", "records"],
)
def test_an_array_that_claims_what_is_not_there_takes_no_memory(content: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(StorageError):
            targets()["member"].read(content)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", ["addresses", "arena", "best", "config", "metrics", "override", "run", "status"])
@pytest.mark.parametrize(
    "nasty", [b"9" * 5000, b"[" * 100_000, b'{"a":' * 100_000, b"a." * 50_000 + b"a = 1", b"\xff\xfe"]
)
def test_numbers_and_nesting_without_end_are_read_or_refused(name: str, nasty: bytes) -> None:
    for content in (nasty, b"seed = " + nasty, b'{"start": ' + nasty + b"}", b'{"score": ' + nasty + b"}\n"):
        take(name, content)


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", npy("(12500000,)", data=bytes(100_000_000)))
    assert path.stat().st_size < 200_000
    for is_packed in (True, False):
        tracemalloc.start()
        try:
            with pytest.raises(StorageError, match="claim more than"):
                read_npz(path, is_packed=is_packed, max_bytes=1_000_000)
            assert tracemalloc.get_traced_memory()[1] < 5e6
        finally:
            tracemalloc.stop()


def test_a_bomb_that_lies_about_its_size_is_refused(tmp_path: Path) -> None:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("a.npy", npy("(1250000,)", data=bytes(10_000_000)))
    size = len(npy("(1250000,)")) + 10_000_000
    lie = archive.getvalue().replace(size.to_bytes(4, "little"), (1000).to_bytes(4, "little"))
    (tmp_path / "bomb.npz").write_bytes(lie)
    tracemalloc.start()
    try:
        with pytest.raises(StorageError):
            read_npz(tmp_path / "bomb.npz", max_bytes=1_000_000)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


def test_many_names_for_one_array_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "quine.npz"
    array = npy("(1000,)", data=bytes(8000))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", array)
        for number in range(100):  # further entries of the directory that point to the same bytes
            again = zipfile.ZipInfo(f"b{number}.npy")
            first = archive.infolist()[0]
            again.header_offset, again.file_size, again.compress_size, again.CRC = (
                first.header_offset, first.file_size, first.compress_size, first.CRC
            )  # fmt: skip
            archive.filelist.append(again)
    with pytest.raises(StorageError, match="claim more than"):
        read_npz(path, is_packed=False)


def test_files_of_text_are_read_up_to_a_limit(tmp_path: Path) -> None:
    long = tmp_path / "long.toml"
    long.write_bytes(b"#" * (1 << 20) + b"\n")
    with pytest.raises(ConfigError, match="larger than"):
        load(long)
    with pytest.raises(ArenaError, match="larger than"):
        load_arena(long)
    long.write_bytes(b"{}" + b" " * 100)
    with pytest.raises(StorageError, match="larger than 50 bytes"):
        read_json(long, max_bytes=50)


def test_an_arena_too_large_for_memory_is_refused_in_no_time(tmp_path: Path) -> None:
    path = tmp_path / "huge.toml"
    path.write_text("start = [0.0, 0.0]\nwalls = [[1e6, 1e6, 0.0, 1.0, 0.1, 1.0]]\n")
    begun_s = time.monotonic()
    with pytest.raises(ArenaError, match=f"at most {MAX_AREA_M2:g} square metres"):
        load_arena(path)
    assert time.monotonic() - begun_s < 10.0


def test_a_small_array_survives(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", allow_pickle=False, a=np.asfortranarray(np.arange(6.0).reshape(2, 3)))
    array = read_npz(tmp_path / "a.npz")["a"]
    np.testing.assert_array_equal(array, np.arange(6.0).reshape(2, 3))
    array[0, 0] = 9.0  # it may be written to

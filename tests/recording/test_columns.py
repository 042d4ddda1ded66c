"""Arrow columns keep numbers bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
import rerun as rr

from apex_bat.recording.columns import image_columns, images_of, tensor_array, tensors_of


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.int16, np.uint8])
@pytest.mark.parametrize("shape", [(1, 5), (4, 3), (2, 3, 4)])
def test_tensors_equal_those_that_rerun_makes_one_by_one(dtype: type[np.generic], shape: tuple[int, ...]) -> None:
    values = (np.random.default_rng(1).random(shape) * 100).astype(dtype)
    singles = [rr.components.TensorDataBatch(value).as_arrow_array() for value in values]
    array = tensor_array(values)
    assert array.type == singles[0].type
    assert array.to_pylist() == [single[0].as_py() for single in singles]


def test_images_come_back() -> None:
    values = np.random.default_rng(2).normal(size=(3, 6, 24)).astype(np.float32)
    (column,) = image_columns(values)
    np.testing.assert_array_equal(images_of(column.as_arrow_array(), 24), values)


def test_empty_columns_are_no_rows() -> None:
    empty = tensor_array(np.zeros((1, 2), np.float32))[:0]
    assert len(tensors_of(rr.ComponentColumn("x", rr.components.ScalarBatch([])).as_arrow_array())) == 0
    assert len(empty) == 0

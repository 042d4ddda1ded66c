"""Arrow columns for `rerun.send_columns` that rerun's own `columns` functions cannot build, and arrays back from them.

`BarChart.columns` and `Tensor.columns` of rerun 0.41 refuse more than one tensor, so their column is put together
here from the public Arrow type of a single tensor.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
import rerun as rr
from numpy.typing import NDArray


class _TensorBatch:
    """A batch of tensors of one shape, in the form that `rr.ComponentColumn` takes."""

    def __init__(self, values: NDArray[np.generic]) -> None:
        self._values = values

    def component_type(self) -> str:
        """Returns rerun's name of the component."""
        return "rerun.components.TensorData"

    def as_arrow_array(self) -> pa.Array:
        """Returns the tensors, one a row."""
        return tensor_array(self._values)


def tensor_array(values: NDArray[np.generic]) -> pa.Array:
    """Returns the tensors values[0], values[1], ... as an Arrow array of rerun's tensor type.

    Args:
        values: any numeric dtype that rerun knows, (rows, ...).
    """
    single = rr.components.TensorDataBatch(values[0]).as_arrow_array()
    buffers = single.type.field("buffer").type
    variant = single.field("buffer")[0].type_code
    rows, size = len(values), values[0].size
    offsets = pa.array(np.arange(rows + 1, dtype=np.int32) * size)
    children = [pa.nulls(0, type=field.type) for field in buffers]
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    children[variant] = pa.ListArray.from_arrays(offsets, flat, type=children[variant].type)
    tags, places = pa.array(np.full(rows, variant, np.int8)), pa.array(np.arange(rows, dtype=np.int32))
    data = pa.Array.from_buffers(buffers, rows, [None, tags.buffers()[1], places.buffers()[1]], children=children)
    shape = pa.array([list(values.shape[1:])] * rows, type=single.type.field("shape").type)
    names = pa.nulls(rows, type=single.type.field("names").type)
    return pa.StructArray.from_arrays([shape, names, data], fields=list(single.type))


def tensor_columns(archetype: Literal["BarChart", "Tensor"], values: NDArray[np.generic]) -> list[rr.ComponentColumn]:
    """Returns the column of one tensor a row; `values` is (rows, ...)."""
    name = {"BarChart": "values", "Tensor": "data"}[archetype]
    descriptor = rr.ComponentDescriptor(
        f"{archetype}:{name}", archetype=f"rerun.archetypes.{archetype}", component_type="rerun.components.TensorData"
    )
    return [rr.ComponentColumn(descriptor, _TensorBatch(values))]


def image_columns(values: NDArray[np.floating]) -> Iterable[rr.ComponentColumn]:
    """Returns the column of one image a row; `values` is float16 or float32 (rows, height, width), top line first.

    Images of numbers are rerun's DepthImage, the only one that the viewer draws through a colour map with a fixed
    range; nothing about them is a depth.
    """
    buffers = np.ascontiguousarray(values).view(np.uint8).reshape(len(values), -1)
    return rr.DepthImage.columns(buffer=buffers)


def tensors_of(column: pa.ListArray) -> NDArray[np.float32]:
    """Returns float32 (rows, ...): the tensors of a column that `tensor_columns` made, all of one shape."""
    tensors = column.flatten()
    if not len(tensors):
        return np.empty((0,), np.float32)
    shape = tensors.field("shape")[0].as_py()
    buffers = tensors.field("buffer")
    variant = buffers.field(buffers.type_codes[0].as_py())
    return np.asarray(variant.flatten().to_numpy(), np.float32).reshape(len(tensors), *shape)


def images_of(column: pa.ListArray, width: int) -> NDArray[np.float32]:
    """Returns float32 (rows, height, width): the images of a column that `image_columns` made."""
    buffers = column.flatten()
    values = np.asarray(buffers.flatten().to_numpy(), np.uint8).view(np.float32)
    return values.reshape(len(buffers), -1, width)

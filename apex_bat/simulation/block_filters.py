"""The cochlea's filters as products of blocks with matrices, in float32: twins of `cochlea` for the fast path.

A product keeps silence silent; an FFT would leave 1e-7 of the loudest echo there, and the compression lifts that to
1e-3. Each bat's products have the same shapes in any company, and so the same bits.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from apex_bat.experience import NUM_EARS
from apex_bat.simulation import cochlea

_BLOCKS_TOGETHER = 4  # BLAS takes as long for 45 blocks as for 48


class BlockFilter:
    """A causal filter for both ears of a bat, as the product of windows of its input with a Toeplitz matrix.

    A sound has one part or two (real, imaginary), which a complex filter mixes and a real one keeps apart. Write a
    sound into `sound`, then call. The scratch memory makes it serve one thread.
    """

    def __init__(self, responses: NDArray[np.float64], num_parts: int, num_samples: int, block: int) -> None:
        """Takes responses (parts in, parts out, taps), of one part each if every part is filtered alike."""
        num_in, self._num_out, num_taps = responses.shape
        window, num_rows = num_taps + block - 1, NUM_EARS * num_parts // num_in
        lag = np.arange(block) - np.arange(window)[:, None] + window - block
        toeplitz = np.where((lag >= 0) & (lag < num_taps), responses[..., np.clip(lag, 0, num_taps - 1)], 0.0)
        matrix = toeplitz.transpose(0, 2, 1, 3).reshape(num_in * window, self._num_out * block)
        self._matrix, self._block = matrix.astype(np.float32), block
        num_blocks = _BLOCKS_TOGETHER * math.ceil(num_samples / (block * _BLOCKS_TOGETHER))
        padded = np.zeros((num_rows, num_in, window - block + num_blocks * block), np.float32)
        self.sound = padded[..., window - block :][..., :num_samples].reshape(NUM_EARS, num_parts, num_samples)
        """float32 (2, parts, samples): what is to be filtered; a view of scratch memory."""
        self._windows = sliding_window_view(padded, window, axis=-1)[:, :, ::block].swapaxes(1, 2)
        self._unrolled = np.empty(self._windows.shape, np.float32)  # BLAS takes no rows that overlap
        self._matrix_rows = self._unrolled.reshape(num_rows, num_blocks, num_in * window)

    def __call__(self, first_sample: int = 0) -> NDArray[np.float32]:
        """Returns the filtered sound, float32 (2, parts out, samples).

        Args:
            first_sample: where the sound begins; what comes before is taken to be silent.
        """
        heard = slice(first_sample // (self._block * _BLOCKS_TOGETHER) * _BLOCKS_TOGETHER, None)
        self._unrolled[:, heard] = self._windows[:, heard]
        num_rows, num_blocks, _ = self._matrix_rows.shape
        blocks: NDArray[np.float32] = np.zeros((num_rows, num_blocks, self._matrix.shape[1]), np.float32)
        np.matmul(self._matrix_rows[:, heard], self._matrix, out=blocks[:, heard])
        if self._num_out > 1:
            blocks = blocks.reshape(num_rows, num_blocks, self._num_out, self._block).swapaxes(1, 2)
        return blocks.reshape(NUM_EARS, -1, num_blocks * self._block)[..., : self.sound.shape[-1]]


class BlockLowPass:
    """The cochlea's low-pass: a triangular matrix within a block, the filter's state between blocks.

    A conjugate pair of poles p with residues r makes the impulse response 2 Re(r p^n), and what all earlier blocks
    leave behind is one complex number.
    """

    def __init__(self, sample_rate_hz: float, num_samples: int, block: int) -> None:
        """Takes a block that divides the number of samples."""
        numerator, denominator = cochlea.butterworth(sample_rate_hz)
        pole = complex(-denominator[1] / 2.0, math.sqrt(denominator[2] - denominator[1] ** 2 / 4.0))
        residue = complex(np.polyval(numerator[::-1], 1.0 / pole)) / (1.0 - pole.conjugate() / pole)
        direct = float(numerator[2] / denominator[2])
        step, block_number = np.arange(block), np.arange(num_samples // block)
        lag = step - step[:, None]
        within = np.where(lag >= 0, 2.0 * np.real(residue * pole ** np.maximum(lag, 0)), 0.0)
        within += direct * np.eye(block)
        from_state = _pairs(2.0 * np.conj(residue * pole**step)).T
        block_lag = block_number - block_number[:, None] - 1
        decay = np.where(block_lag >= 0, pole ** (block * np.maximum(block_lag, 0)), 0.0)
        self._block = block
        self._state_of = _pairs(np.complex128(pole) ** (block - step)).astype(np.float32)
        self._carry = _rotations(decay).astype(np.float32)
        self._envelope_of = np.concatenate([within, from_state]).astype(np.float32)

    def __call__(self, compressed: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the envelope (rows, samples) of (rows, samples), its undershoot not yet cut off."""
        num_rows, block = len(compressed), self._block
        blocks = np.empty((num_rows, compressed.shape[1] // block, block + 2), np.float32)  # and the state before each
        blocks[..., :block] = compressed.reshape(num_rows, -1, block)
        left_behind = blocks[..., :block] @ self._state_of
        state = left_behind.reshape(num_rows, 1, -1) @ self._carry
        blocks[..., block:] = state.reshape(num_rows, -1, 2)
        envelope: NDArray[np.float32] = blocks @ self._envelope_of
        return envelope.reshape(compressed.shape)


def _pairs(numbers: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Returns (n, 2): real and imaginary parts."""
    return np.stack((numbers.real, numbers.imag), axis=-1)


def _rotations(factors: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Returns the real (2 n, 2 m) matrix that multiplies rows of n pairs (real, imaginary) with complex (n, m)."""
    turns = np.stack((_pairs(factors), _pairs(1j * factors)), axis=1)  # (n, from part, m, to part)
    return turns.reshape(2 * len(factors), -1)

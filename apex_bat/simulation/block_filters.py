"""The cochlea's filters as products of blocks with matrices, in float32: twins of `cochlea` for the fast path.

A product keeps silence silent; an FFT would leave 1e-7 of the loudest echo there, and the compression lifts that to
1e-3. The products of one row are the same whatever else is computed, so that a bat hears the same bits in any company.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import signal

from apex_bat.experience import NUM_EARS
from apex_bat.simulation import cochlea


class BlockFilter:
    """A causal filter for both ears, as the product of windows of its input with a Toeplitz matrix.

    A sound has one part or two (real, imaginary), which a complex filter mixes and a real one keeps apart. The scratch
    memory it holds makes it serve one thread.
    """

    def __init__(self, responses: NDArray[np.float64], num_parts: int, num_samples: int, block: int) -> None:
        """Takes responses (parts in, parts out, taps), of one part each if every part is filtered alike."""
        num_in, self._num_out, num_taps = responses.shape
        window, num_rows = num_taps + block - 1, NUM_EARS * num_parts // num_in
        lag = np.arange(block) - np.arange(window)[:, None] + window - block
        toeplitz = np.where((lag >= 0) & (lag < num_taps), responses[..., np.clip(lag, 0, num_taps - 1)], 0.0)
        matrix = toeplitz.transpose(0, 2, 1, 3).reshape(num_in * window, self._num_out * block)
        self._matrix = matrix.astype(np.float32)
        padded = np.zeros((num_rows, num_in, window - block + num_samples), np.float32)
        self._input = padded[..., window - block :]
        self._windows = sliding_window_view(padded, window, axis=-1)[:, :, ::block].swapaxes(1, 2)
        self._unrolled = np.empty(self._windows.shape, np.float32)  # BLAS takes no rows that overlap
        self._matrix_rows = self._unrolled.reshape(num_rows, -1, num_in * window)

    def __call__(self, sound: NDArray[np.float64]) -> NDArray[np.float32]:
        """Returns the filtered sound (2, parts out, samples) of (2, parts, samples)."""
        self._input[:] = sound.reshape(self._input.shape)
        self._unrolled[:] = self._windows
        blocks: NDArray[np.float32] = self._matrix_rows @ self._matrix
        if self._num_out > 1:
            blocks = blocks.reshape(*blocks.shape[:2], self._num_out, -1).swapaxes(1, 2)
        return blocks.reshape(NUM_EARS, -1, sound.shape[-1])


class BlockLowPass:
    """The cochlea's low-pass for both ears: a triangular matrix within a block, the filter's state between blocks.

    A conjugate pair of poles p with residues r makes the impulse response 2 Re(r p^n), and what all earlier blocks
    leave behind is one complex number.
    """

    def __init__(self, sample_rate_hz: float, num_samples: int, block: int) -> None:
        numerator, denominator = signal.butter(2, cochlea.LOW_PASS_HZ, fs=sample_rate_hz)
        residues, poles, direct = signal.residuez(numerator, denominator)
        residue, pole = residues[0], poles[0]
        step, block_number = np.arange(block), np.arange(num_samples // block)
        lag = step - step[:, None]
        within = np.where(lag >= 0, 2.0 * np.real(residue * pole ** np.maximum(lag, 0)), 0.0)
        within += direct[0] * np.eye(block)
        block_lag = block_number - block_number[:, None] - 1
        decay = np.where(block_lag >= 0, pole ** (block * np.maximum(block_lag, 0)), 0.0)
        self._block = block
        self._within = within.astype(np.float32)
        self._state_of = _pairs(pole ** (block - step)).astype(np.float32)
        self._carry = _rotations(decay).astype(np.float32)
        self._from_state = _pairs(2.0 * np.conj(residue * pole**step)).T.astype(np.float32)

    def __call__(self, compressed: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the envelope (2, samples) of (2, samples), its undershoot not yet cut off."""
        blocks = compressed.reshape(NUM_EARS, -1, self._block)
        left_behind = (blocks @ self._state_of).reshape(NUM_EARS, 1, -1)
        state = (left_behind @ self._carry).reshape(NUM_EARS, -1, 2)
        envelope: NDArray[np.float32] = blocks @ self._within
        envelope += state @ self._from_state
        return envelope.reshape(compressed.shape)


def _pairs(numbers: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Returns (n, 2): real and imaginary parts."""
    return np.stack((numbers.real, numbers.imag), axis=-1)


def _rotations(factors: NDArray[np.complex128]) -> NDArray[np.float64]:
    """Returns the real (2 n, 2 m) matrix that multiplies rows of n pairs (real, imaginary) with complex (n, m)."""
    turns = np.stack((_pairs(factors), _pairs(1j * factors)), axis=1)  # (n, from part, m, to part)
    return turns.reshape(2 * len(factors), -1)

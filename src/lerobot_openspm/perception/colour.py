"""Colour evidence: CIELAB histograms, and the foreground probability of every pixel.

Colours are counted in bins of CIELAB, fine in the two chromatic axes and coarse in lightness, which varies
with the shading of a face. An object's colour model is one table: the log-odds, per bin, that a pixel of that
colour is the object's rather than its surroundings'.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from lerobot_openspm.geometry.se3 import Array

# Bins per axis of 8-bit CIELAB. The chromatic axes are clipped to [64, 192): beyond that nothing is confused.
LAB_BINS = (32, 32, 32)
N_BINS = 32 * 32 * 32
MAX_LOG_ODDS = 6.0
# A colour may occur this much (as a logarithm) more often elsewhere and still count as the object's.
PRIOR = 0.5

Bins = NDArray[np.int32]


def lab_bins(image: NDArray[np.uint8]) -> Bins:
    """Bin index ``(H, W)`` of every pixel of an RGB image ``(H, W, 3)``."""
    lab = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2LAB).astype(np.int32)
    chroma = (np.clip(lab[..., 1:], 64, 191) - 64) >> 2
    return ((lab[..., 0] >> 3) * 1024 + chroma[..., 0] * 32 + chroma[..., 1]).astype(np.int32)


def histogram(bins: Bins) -> Array:
    """Counts ``(N_BINS,)`` of bin indices of any shape."""
    return np.bincount(bins.ravel(), minlength=N_BINS).astype(float)


def smooth(counts: Array) -> Array:
    """Spread counts ``(N_BINS,)`` over neighbouring colours, the total kept."""
    return gaussian_filter(counts.reshape(LAB_BINS), (0.7, 0.7, 0.7), mode="nearest", truncate=3.0).ravel()


def foreground(bins: Bins, log_odds: NDArray[np.float32]) -> NDArray[np.float32]:
    """Soft foreground probability ``(H, W)``: the colour evidence, averaged lightly over neighbours."""
    table = 1.0 / (1.0 + np.exp(-log_odds))
    return np.asarray(cv2.GaussianBlur(table[bins].astype(np.float32), (3, 3), 0.6), np.float32)


def evidence(inside: list[Array], outside: Array, min_presence: float) -> NDArray[np.float32]:
    """Log-odds per colour from pixels near an object and pixels elsewhere.

    A colour belongs to the object when it is denser near it than elsewhere, and near it in most pictures:
    what merely stood next to it once is present in few.

    Args:
        inside: One histogram ``(N_BINS,)`` per picture, of the pixels near the object.
        outside: Histogram ``(N_BINS,)`` of the pixels elsewhere in the same pictures.
        min_presence: Fraction of the pictures in which the object's colours are expected.

    Returns:
        Log-odds ``(N_BINS,)``; very negative for colours never seen near the object.
    """
    # Counts, not shares: what matters is which part of all pixels of a colour lies near the object, so that a
    # large uniform background cannot creep in through the few of its pixels that surround the object.
    near, far = smooth(np.sum(inside, axis=0)), smooth(outside)
    # Present: about two pixels of that colour (or of its neighbours) near the object.
    neighbourhood = np.stack([_neighbourhood(counts) for counts in inside])
    presence = (neighbourhood >= 2.0).mean(axis=0)
    pictures = len(inside)
    # Less than a hundredth of a pixel per picture: an unseen colour is no evidence for the object.
    ratio = np.log((near + 0.01 * pictures) / (far + 0.04 * pictures)) + PRIOR
    consensus = 8.0 * (presence - min_presence)
    return np.clip(ratio + np.minimum(consensus, 0.0), -MAX_LOG_ODDS, MAX_LOG_ODDS).astype(np.float32)


def _neighbourhood(counts: Array) -> Array:
    """Sum of the counts ``(N_BINS,)`` over each bin's 3 x 3 x 3 neighbourhood."""
    cube = counts.reshape(LAB_BINS)
    for axis in range(3):
        padded = np.pad(cube, [(1, 1) if i == axis else (0, 0) for i in range(3)])
        n = cube.shape[axis]
        cube = np.sum([np.take(padded, range(k, k + n), axis=axis) for k in range(3)], axis=0)
    return cube.ravel()

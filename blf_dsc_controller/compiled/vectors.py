# SPDX-License-Identifier: Apache-2.0
"""Vectors of three entries as tuples, which kernels keep in registers."""

import numpy as np

from blf_dsc_controller.compiled.jit import inner

Vector = tuple[float, float, float]


@inner
def vector(a: np.ndarray) -> Vector:
    """Return an array (3,) as a vector."""
    return a[0], a[1], a[2]


@inner
def put(a: Vector, out: np.ndarray) -> None:
    """Write a vector into an array (3,)."""
    out[0], out[1], out[2] = a


@inner
def plus(a: Vector, b: Vector) -> Vector:
    """Return a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inner
def times(k: float, a: Vector) -> Vector:
    """Return k a."""
    return k * a[0], k * a[1], k * a[2]


@inner
def cross(a: Vector, b: Vector) -> Vector:
    """Return the cross product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inner
def dot(a: Vector, b: Vector) -> float:
    """Return the scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def product(A: np.ndarray, b: Vector) -> Vector:
    """Return the product of a matrix (3, 3) and a vector."""
    return dot(vector(A[0]), b), dot(vector(A[1]), b), dot(vector(A[2]), b)

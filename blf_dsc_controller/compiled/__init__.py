# SPDX-License-Identifier: Apache-2.0
"""Compilation of the numerical kernels: jit with its cache, views of flat vectors."""

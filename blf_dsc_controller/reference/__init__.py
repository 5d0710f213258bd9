# SPDX-License-Identifier: Apache-2.0
"""Reference trajectories: their kernels, their planning and their limits."""

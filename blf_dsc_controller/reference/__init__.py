# SPDX-License-Identifier: Apache-2.0
"""Reference trajectories: kernels, planning and limits."""

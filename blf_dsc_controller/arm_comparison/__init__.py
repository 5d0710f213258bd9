# SPDX-License-Identifier: Apache-2.0
"""Comparison of laws, tuned by one procedure, on arms whose URDF is wrong."""

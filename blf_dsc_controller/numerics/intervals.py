# SPDX-License-Identifier: Apache-2.0
"""Confidence intervals."""

TWO_SIDED = 1.96
"""Standard deviations in half of a 95 % interval."""

# SPDX-License-Identifier: Apache-2.0
"""Thousands of closed loops with random plants: drawn, run in parallel, kept, and judged."""

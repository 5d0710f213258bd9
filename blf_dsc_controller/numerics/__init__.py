# SPDX-License-Identifier: Apache-2.0
"""Numerics with the same bits on every processor: elementary functions and linear algebra."""

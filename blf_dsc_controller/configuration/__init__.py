# SPDX-License-Identifier: Apache-2.0
"""Frozen dataclasses of parameters, and the files that set them."""

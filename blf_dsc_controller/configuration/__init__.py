# SPDX-License-Identifier: Apache-2.0
"""Configuration: frozen dataclasses that say what can be set, and parameter files that set it."""

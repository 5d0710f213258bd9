# SPDX-License-Identifier: Apache-2.0
"""Studies that a user runs on an arm: laws side by side, and Monte Carlo studies."""

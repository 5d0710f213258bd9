# SPDX-License-Identifier: Apache-2.0
"""Section IV of the paper: every law side by side, and its claims evaluated."""

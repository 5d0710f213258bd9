# SPDX-License-Identifier: Apache-2.0
"""Section IV of the paper: comparison of all laws, and evaluation of its claims."""

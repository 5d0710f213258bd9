# SPDX-License-Identifier: Apache-2.0
"""Section IV of the paper run side by side, and how far its claims hold."""

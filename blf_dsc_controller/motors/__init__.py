# SPDX-License-Identifier: Apache-2.0
"""Motors with a PD of their own: what a frame to them carries, and what they make of it."""

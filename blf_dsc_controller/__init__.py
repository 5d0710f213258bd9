# SPDX-License-Identifier: Apache-2.0
"""Output-constrained tracking of robot arms with unknown dynamics, as ROS 2 nodes."""

__version__ = '0.1.0'

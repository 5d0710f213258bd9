# SPDX-License-Identifier: Apache-2.0
"""Making references: through points, from where the arm is, within its limits. No ROS."""

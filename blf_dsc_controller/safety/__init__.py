# SPDX-License-Identifier: Apache-2.0
"""What stands between the joint states and the law, and between the law and the arm; no ROS."""

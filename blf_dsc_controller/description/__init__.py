# SPDX-License-Identifier: Apache-2.0
"""The two-link arm as robot tools know it: its URDF, and its pose in space."""

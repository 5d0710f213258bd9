# SPDX-License-Identifier: Apache-2.0
"""Identification of the arm of a URDF from any bag, and correction of the URDF."""

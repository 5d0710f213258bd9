# SPDX-License-Identifier: Apache-2.0
"""The arm of a URDF identified from any bag, and the URDF corrected."""

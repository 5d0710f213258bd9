# SPDX-License-Identifier: Apache-2.0
"""Arm models: regressors and inertia of each arm, behind one interface."""

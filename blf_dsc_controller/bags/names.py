# SPDX-License-Identifier: Apache-2.0
"""Names under which values travel in the named vectors (learning, truth, timing)."""

from __future__ import annotations

DISTURBANCE = 'disturbance '  # followed by the joint
BIAS = 'bias '  # likewise, a constant torque that is learned
POSITION = 'position '  # likewise
VELOCITY = 'velocity '  # likewise
LAMBDA_MIN = 'lambda_min'
LATCHED = 'latched'
COMPUTE_TIME = 'compute_time'
LATENCY = 'latency'
LATENESS = 'lateness'
LATE_STEPS = 'late_steps'

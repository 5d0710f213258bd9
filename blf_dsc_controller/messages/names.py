# SPDX-License-Identifier: Apache-2.0
"""Names of the values in the published vectors, in `/diagnostics` and in `~/state`."""

from __future__ import annotations

# In the vectors learning, truth, timing, monitor.
DISTURBANCE = 'disturbance '  # followed by the joint
BIAS = 'bias '  # followed by the joint: a constant torque that is learned
POSITION = 'position '  # followed by the joint
VELOCITY = 'velocity '  # followed by the joint
RATIO = 'max_error_ratio '  # followed by the joint: the largest |xi1| / k_c so far
DISTANCE = 'distance_to_bound '  # followed by the joint: k_c - |xi1|
LYAPUNOV = 'V '  # followed by the term of (29), or by `bound` for (32)
LAMBDA_MIN = 'lambda_min'
LATCHED = 'latched'
COMPUTE_TIME = 'compute_time'
LATENCY = 'latency'
LATENESS = 'lateness'
LATE_STEPS = 'late_steps'

# In /diagnostics.
REJECTED = 'rejected '  # followed by the column that is not estimated

# In ~/state.
PHASE = 'phase'
REASON = 'reason'
STOPS = 'stops'  # since the node was configured

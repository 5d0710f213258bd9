# SPDX-License-Identifier: Apache-2.0
"""Names under which values travel: in the vectors (learning, truth, timing), and beside them."""

from __future__ import annotations

DISTURBANCE = 'disturbance '  # followed by the joint
BIAS = 'bias '  # likewise, a constant torque that is learned
POSITION = 'position '  # likewise
VELOCITY = 'velocity '  # likewise
RATIO = 'max_error_ratio '  # likewise, the largest |xi1| / k_c so far
DISTANCE = 'distance_to_bound '  # likewise, k_c - |xi1|
LYAPUNOV = 'V '  # followed by the term of (29), or by `bound` for (32)
LAMBDA_MIN = 'lambda_min'
LATCHED = 'latched'
COMPUTE_TIME = 'compute_time'
LATENCY = 'latency'
LATENESS = 'lateness'
LATE_STEPS = 'late_steps'

REFUSED = (
    'refused '  # of the values of /diagnostics: followed by the column, which is not estimated
)

# Of the values of ~/state.
PHASE = 'phase'
REASON = 'reason'
STOPS = 'stops'  # since the node was configured
OPERATIONS = 'operations'  # likewise: activations, deactivations and resets
OPERATION = 'last operation'
LAST_STATE = 'last state'  # stamp of the last joint state that came by then, ns

# SPDX-License-Identifier: Apache-2.0
"""What cannot work well is found before anything moves: refused, or warned of.

table            all warnings of a configuration, each with when it applies
stability        gains that are too high for the loop: refused, if no arm bears them
gains            limits of gains and torques in a sampled loop
bounds           bounds that bound nothing, or that the errors to expect leave
bodies           bodies and ranges that no arm has
not_commissioned gains that nobody has measured
expected_errors  the errors to expect, by the linear loop
reference_load   torque, inertia and excitation along the reference
"""

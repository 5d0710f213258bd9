# SPDX-License-Identifier: Apache-2.0
"""What cannot work well is found before anything moves: refused, or warned of.

table            all rules of a start and of other gains, and what they find
case             what they look at: a configuration, and what follows from it
stability        gains that are too high for the loop, that hold softly, that nobody has measured
gains            limits of gains and torques in a sampled loop
bounds           bounds that bound nothing, or that the errors to expect leave
bodies           bodies and ranges that no arm has
expected_errors  the errors to expect, by the linear loop
reference_load   torque, inertia and excitation along the reference
"""

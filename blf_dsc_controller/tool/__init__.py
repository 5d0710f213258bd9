# SPDX-License-Identifier: Apache-2.0
"""The error at the tool that errors of the joints can cause, with certified bounds."""

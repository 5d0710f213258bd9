# SPDX-License-Identifier: Apache-2.0
"""The compiled law of a configuration in a folder, to be called from C."""

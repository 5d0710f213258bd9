# SPDX-License-Identifier: Apache-2.0
"""Browser page that shows an arm and its controller, live or from a bag."""

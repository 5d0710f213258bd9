# SPDX-License-Identifier: Apache-2.0
"""The messages of the package: topics, CDR encoding, telemetry."""

# SPDX-License-Identifier: Apache-2.0
"""`blf_dsc paper`: the paper's Section IV, its claims, and where each law breaks, as a report."""

from __future__ import annotations

from argparse import Namespace

from blf_dsc_controller.cli.run import make_folder
from blf_dsc_controller.paper.report import compare


def paper(options: Namespace) -> None:
    """Run the study and print the claims."""
    for claim in compare(make_folder(options.out)):
        print(f'{claim.where:<18} {claim.says}\n{"":<18} {claim.full_verdict}')
    print(f'wrote {options.out / "index.html"}')

# SPDX-License-Identifier: Apache-2.0
"""All that is told of a study: report.md, its pictures, and summary.json, in its own folder."""

from __future__ import annotations

from pathlib import Path

from blf_dsc_controller.analysis.summary import write_summary
from blf_dsc_controller.monte_carlo.figures import draw_study
from blf_dsc_controller.monte_carlo.page import page
from blf_dsc_controller.monte_carlo.statistics import Summary, judge
from blf_dsc_controller.monte_carlo.store import Store


def write_report(store: Store) -> tuple[Summary, list[Path]]:
    """Judge and draw what there is; it may be done again at any time.

    Returns the summary, and what was written. Raises NoResultsError where there is nothing yet.
    """
    results = store.results()
    summary = judge(store.study, results)
    pictures = draw_study(store.study, results, store.folder)
    written = [store.folder / 'report.md', *pictures, store.folder / 'summary.json']
    write_summary(summary, store.folder / 'summary.json')
    text = page(store.study, summary, store.folder, pictures)
    (store.folder / 'report.md').write_text(text, encoding='utf-8')
    return summary, written

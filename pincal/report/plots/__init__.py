"""Figures of results, drawn on canvases of their own: nothing is shown, no state of matplotlib is touched.

Each function takes a result and returns a :class:`matplotlib.figure.Figure`; save it with ``figure.savefig``. Those of a
calibration take :class:`~pincal.report.evidence.Evidence`:

    evidence = pincal.report.evidence.evidence_of(run)[0]
    pincal.report.plots.errors.cumulative_figure(evidence).savefig("errors.png")
"""

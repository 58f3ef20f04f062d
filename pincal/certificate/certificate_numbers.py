"""The numbers that a certificate states with each uncertainty, each with its unit and origin."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number


@dataclass(frozen=True, kw_only=True)
class CertificateNumbers:
    """How uncertainties are expanded."""

    probability: float = number(
        0.95,
        "probability",
        "test_certificate.py::test_a_part_keeps_values_limits_and_decisions",
        "of the interval of an expanded uncertainty",
        "convention of calibration certificates, with k = 2",
    )


CERTIFICATE = CertificateNumbers()

"""The numbers that a certificate states with each uncertainty, each with its unit and origin."""

from __future__ import annotations

from dataclasses import dataclass

from pincal.thresholds import number


@dataclass(frozen=True, kw_only=True)
class CertificateNumbers:
    """How uncertainties are expanded."""

    coverage: float = number(
        2.0,
        "ratio",
        "test_certificate.py::test_the_uncertainty_of_positions_is_twice_the_root_of_the_budget",
        "of the expanded to the standard uncertainty, k",
        "GUM 6.3.3 and ISO/IEC 17025 practice: about 95 % of a normal distribution",
    )
    probability: float = number(
        0.95,
        "probability",
        "test_certificate.py::test_a_part_keeps_values_limits_and_decisions",
        "of the interval of an expanded uncertainty",
        "convention of calibration certificates, with k = 2",
    )


CERTIFICATE = CertificateNumbers()

"""Certificates: one page to sign, and the same as a digital calibration certificate.

What a certificate says is a :class:`pincal.certificate.contents.Certificate`, made of a calibrated
model or of a measured part; the page and the XML are two ways of writing it.
"""

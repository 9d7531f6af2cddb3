"""Domains of physics, by the units of a potential and of a flow."""

from __future__ import annotations

from typing import Literal as Choice

from fmu_build.unit_strings import parse_unit

Domain = Choice["rotational", "translational", "electrical", "thermal", "fluid", "signal", "parameter"]

DOMAINS: tuple[tuple[Domain, str, tuple[str, ...]], ...] = (
    ("rotational", "rad", ("N.m",)),
    ("translational", "m", ("N",)),
    ("electrical", "V", ("A",)),
    ("thermal", "K", ("W",)),
    ("fluid", "Pa", ("m3/s", "kg/s")),
    ("fluid", "m", ("m3/s", "kg/s")),
)
MECHANICAL: tuple[Domain, ...] = ("rotational", "translational")


def domain_of(potential: str | None, flow: str | None) -> Domain | None:
    """Return the domain of a potential and a flow with these units, None if there is none."""
    p, f = _dimension(potential), _dimension(flow)
    for domain, one, others in DOMAINS:
        if p is not None and p == _dimension(one) and f in [_dimension(other) for other in others]:
            return domain
    return None


def alike(domain: Domain) -> tuple[Domain, ...]:
    """Return the domains that may share a component: both mechanical ones, or the domain alone."""
    return MECHANICAL if domain in MECHANICAL else (domain,)


def _dimension(unit: str | None) -> tuple[int, ...] | None:
    parsed = parse_unit(unit) if unit else None
    return None if parsed is None else parsed[2]

"""Where the sun stands: Meeus's low-accuracy formulas (Astronomical Algorithms, 1998, ch. 25).

Good to 0.02 degree between 1950 and 2100; refraction at 10 degrees C and 1010 hPa included.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime

from chromeball.scene.errors import UserError


@dataclass(frozen=True)
class SunPosition:
    """``azimuth`` clockwise from north, ``elevation`` above the horizon as seen; radians."""

    azimuth: float
    elevation: float


def sun_position(when: datetime, latitude: float, longitude: float) -> SunPosition:
    """The sun at a time with its zone, at degrees north and degrees east.

    Raises
    ------
    UserError
        For a time without a zone, or a place that is none.

    """
    if when.tzinfo is None:
        raise UserError(
            f"time {when.isoformat()} has no zone: add it, as in 2026-06-21T14:30+02:00"
        )
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        raise UserError(
            f"latitude {latitude:g}, longitude {longitude:g}: degrees north, -90 to 90, and "
            "east, -180 to 180"
        )
    days = (when - datetime(2000, 1, 1, 12, tzinfo=UTC)).total_seconds() / 86400
    # the earth lags atomic time by about 64 s in 2000 and 75 s in 2050; 70 s is .0008 degree
    t = (days + 70 / 86400) / 36525
    mean_longitude = 280.46646 + t * (36000.76983 + 0.0003032 * t)
    anomaly = math.radians(357.52911 + t * (35999.05029 - 0.0001537 * t))
    centre = (
        (1.914602 - t * (0.004817 + 0.000014 * t)) * math.sin(anomaly)
        + (0.019993 - 0.000101 * t) * math.sin(2 * anomaly)
        + 0.000289 * math.sin(3 * anomaly)
    )
    node = math.radians(125.04 - 1934.136 * t)
    apparent = math.radians(
        mean_longitude + centre - 0.00569 - 0.00478 * math.sin(node)  # aberration, nutation
    )
    tilt = math.radians(23.4392911 - 0.0130042 * t + 0.00256 * math.cos(node))
    ascension = math.atan2(math.cos(tilt) * math.sin(apparent), math.cos(apparent))
    declination = math.asin(math.sin(tilt) * math.sin(apparent))
    # sidereal time at Greenwich (Meeus 12.4), apparent by the nutation's largest term
    sidereal = 280.46061837 + 360.98564736629 * days - 0.00437 * math.sin(node)
    hour = math.radians((sidereal + longitude) % 360) - ascension
    phi = math.radians(latitude)
    true = math.asin(
        math.sin(phi) * math.sin(declination)
        + math.cos(phi) * math.cos(declination) * math.cos(hour)
    )
    azimuth = math.atan2(
        -math.sin(hour) * math.cos(declination),
        math.cos(phi) * math.sin(declination)
        - math.sin(phi) * math.cos(declination) * math.cos(hour),
    )
    return SunPosition(azimuth % (2 * math.pi), true - PARALLAX * math.cos(true) + lift(true))


#: Of the sun on the horizon, radians.
PARALLAX = math.radians(8.794 / 3600)


def lift(true: float) -> float:
    """Refraction at a true elevation (Saemundsson 1986), radians."""
    degrees = math.degrees(true)
    if degrees < -1:
        return 0.0
    minutes = 1.02 / math.tan(math.radians(degrees + 10.3 / (degrees + 5.11)))
    return math.radians(max(minutes, 0.0) / 60)


def parse_time(text: str) -> datetime:
    """ISO 8601 with its zone.

    Raises
    ------
    UserError
        When it is not, or has no zone.

    """
    try:
        when = datetime.fromisoformat(text)
    except ValueError as error:
        raise UserError(f"time {text!r}: write it as 2026-06-21T14:30+02:00") from error
    if when.tzinfo is None:
        raise UserError(f"time {text!r} has no zone: add it, as in 2026-06-21T14:30+02:00")
    return when

"""Synthetic files of OpenSky's format: aircraft that fly straight, one report each per scan."""

import csv
import math

A, E_SQUARED = 6378137.0, 0.00669437999014
"""WGS84 semi-major axis (m) and squared eccentricity."""

COLUMNS = ("time", "icao24", "lat", "lon", "velocity", "heading", "vertrate", "callsign", "onground", "alert")
COLUMNS += (
    "spi",
    "squawk",
    "baroaltitude",
    "geoaltitude",
    "lastposupdate",
    "lastcontact",
    "x_speed",
    "y_speed",
)

START = 1_600_000_000
INTERVAL = 10

FLEET = (
    # icao24, lat (deg), lon (deg), altitude (m), speed (m/s), heading (deg), climb (m/s)
    ("aaaa01", 52.0, -1.0, 10_000.0, 230.0, 90.0, 0.0),
    ("aaaa02", 52.3, -0.5, 8_000.0, 200.0, 200.0, -8.0),
    ("aaaa03", 51.8, 0.2, 6_000.0, 150.0, 315.0, 5.0),
    ("aaaa04", 52.6, -0.2, 11_000.0, 250.0, 10.0, 0.0),
)


def fly(latitude, longitude, altitude, speed, heading, climb, seconds):
    """Where a straight flight is after some seconds, by the ellipsoid's radii of curvature."""
    root = math.sqrt(1 - E_SQUARED * math.sin(math.radians(latitude)) ** 2)
    meridian, normal = A * (1 - E_SQUARED) / root**3, A / root
    north, east = speed * math.cos(math.radians(heading)), speed * math.sin(math.radians(heading))
    across = (normal + altitude) * math.cos(math.radians(latitude))
    return (
        latitude + math.degrees(north * seconds / (meridian + altitude)),
        longitude + math.degrees(east * seconds / across),
        altitude + climb * seconds,
    )


def state_rows(num_scans=6, fleet=FLEET):
    """Rows, scan by scan; the aircraft in the order of the fleet."""
    rows = []
    for scan in range(num_scans):
        time = START + INTERVAL * scan
        for name, latitude, longitude, altitude, speed, heading, climb in fleet:
            place = fly(latitude, longitude, altitude, speed, heading, climb, INTERVAL * scan)
            row = dict.fromkeys(COLUMNS, "")
            row |= {"time": time, "icao24": name, "lat": place[0], "lon": place[1], "velocity": speed}
            row |= {"heading": heading, "vertrate": climb, "onground": "False", "callsign": "TEST   "}
            row |= {"baroaltitude": place[2] - 100, "geoaltitude": place[2], "lastposupdate": time}
            rows.append(row)
    return rows


def write_states(path, rows):
    """Writes the rows and returns the path."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return path

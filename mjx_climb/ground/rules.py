"""Grounds made by rule: where the points are that can be held, and how the surface lies there.

Each rule returns positions (n, 3) m and normals (n, 3), of any length above 0, 1; z is up from the area's plane.
"""

import math

import numpy as np

from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.model import Handrails, HoldWall, Pipe, Rock, Truss
from mjx_climb.scenario.values import MAX_COUNT

_UP = np.array([0.0, 0.0, 1.0])
_WAVES = 24  # of a rough surface
_SHORTEST = 0.125  # of the wavelengths, as a share of the longest one
_MOST = 50 * MAX_COUNT  # points that are made, before spacing thins them out

Points = tuple[np.ndarray, np.ndarray]


def handrails(rails: Handrails, random: np.random.Generator) -> Points:
    """Points along rails that run along x; a single rail lies in the middle."""
    _check("handrails", rails.size[0] / rails.pitch, rails.rails)
    x = _spread(rails.size[0], rails.pitch)
    y = rails.size[1] * (np.linspace(0, 1, rails.rails) if rails.rails > 1 else np.array([0.5]))
    position = np.stack(np.meshgrid(x, y, 0.0), axis=-1).reshape(-1, 3)
    return _placed(position, rails.corner), np.tile(_UP, (len(position), 1))


def truss(box: Truss, random: np.random.Generator) -> Points:
    """Points along the members of a lattice, or of the four faces of a box around x, each with its face's normal."""
    (length, width), depth = box.size, box.depth
    across, down, out = np.array([0, 1.0, 0]), -_UP, np.array([0, 1.0, 0])
    corner = np.array([0, width, -depth])
    bay = min(box.bay, length + width)
    # two sides of a bay and its diagonal, on both faces that are alike
    _check("truss", length / bay + 1, (width + depth) / bay + 1, 8 * (bay / box.pitch + 1))
    # a face: where it begins, which way it goes beside x, how far, and its normal
    faces = [(np.zeros(3), across, width, _UP)]
    if depth:
        faces += [(np.zeros(3), down, depth, -out), (corner, -down, depth, out), (corner, -across, width, -_UP)]
    position, normal = [], []
    for start, aside, wide, up in faces:
        flat = _lattice(length, wide, box.bay, box.pitch)
        position.append(start + flat[:, :1] * [1.0, 0, 0] + flat[:, 1:] * aside)
        normal.append(np.tile(up, (len(flat), 1)))
    return _placed(np.concatenate(position), box.corner), np.concatenate(normal)


def pipe(tube: Pipe, random: np.random.Generator) -> Points:
    """Points on rings around a pipe, whose uppermost line is at height zero."""
    _check("pipe", tube.size[0] / tube.pitch, tube.around)
    angle = 2 * np.pi * np.arange(tube.around) / tube.around
    normal = np.stack([np.zeros_like(angle), np.sin(angle), np.cos(angle)], axis=-1)
    x = _spread(tube.size[0], tube.pitch)
    rings = tube.radius * (normal - _UP) + [0, tube.size[1] / 2, 0]
    position = rings + x[:, None, None] * [1.0, 0, 0]
    return _placed(position.reshape(-1, 3), tube.corner), np.tile(normal, (x.size, 1))


def wall(holds: HoldWall, random: np.random.Generator) -> Points:
    """Holds on a grid whose odd rows are shifted by half a pitch."""
    _check("wall", *(side / holds.pitch + 1 for side in holds.size))
    x, y = np.meshgrid(*(_spread(side, holds.pitch) for side in holds.size))
    x = x + holds.pitch / 2 * (np.arange(len(x)) % 2)[:, None]
    position = np.stack([x, y, holds.height * random.random(x.shape)], axis=-1)
    normal = np.tile(_UP, (*x.shape, 1))
    normal[..., :2] = np.tan(np.clip(holds.tilt * random.standard_normal((*x.shape, 2)), -1.5, 1.5))
    kept = (x <= holds.size[0] + 1e-9) & (random.random(x.shape) < holds.filled)
    return _placed(position[kept], holds.corner), normal[kept]


def rock(ground: Rock, random: np.random.Generator) -> Points:
    """Uniform points on a sum of waves of random directions, the shorter the lower."""
    _check("rock", ground.density, *ground.size)
    count = round(ground.density * ground.size[0] * ground.size[1])
    level = random.random((count, 2)) * ground.size
    length = ground.wavelength * _SHORTEST ** random.random(_WAVES)
    direction, phase = 2 * np.pi * random.random((2, _WAVES))
    number = 2 * np.pi / length * [np.cos(direction), np.sin(direction)]
    # slopes of all waves are alike; a wave's variance is half its squared amplitude
    amplitude = ground.roughness * length / np.sqrt((length**2).sum() / 2)
    angle = level @ number + phase
    slope = -(amplitude * np.sin(angle)) @ number.T
    position = np.column_stack([level, np.cos(angle) @ amplitude])
    return _placed(position, ground.corner), np.column_stack([-slope, np.ones(count)])


def _lattice(length: float, width: float, bay: float, pitch: float) -> np.ndarray:
    """Points (n, 2) m along chords, battens and diagonals, which change their direction from bay to bay."""
    columns, rows = (max(round(side / bay), 1) for side in (length, width))
    node = np.stack(np.meshgrid(np.linspace(0, length, columns + 1), np.linspace(0, width, rows + 1)), axis=-1)
    rising = (np.indices((rows, columns)).sum(0) % 2 == 0)[..., None]
    ends = [
        (node[:, :-1], node[:, 1:]),
        (node[:-1], node[1:]),
        (np.where(rising, node[:-1, :-1], node[1:, :-1]), np.where(rising, node[1:, 1:], node[:-1, 1:])),
    ]
    found = [node.reshape(-1, 2)]
    for start, end in ends:
        start, end = start.reshape(-1, 2), end.reshape(-1, 2)
        pieces = max(int(np.ceil(np.linalg.norm(end - start, axis=1).max() / pitch - 1e-9)), 1)
        share = np.arange(1, pieces)[:, None, None] / pieces
        found.append((start + share * (end - start)).reshape(-1, 2))
    return np.concatenate(found)


def _check(rule: str, *factors: float) -> None:
    """Refuse a rule that would make too many points, some product of factors."""
    if (number := math.prod(factors)) > _MOST:
        raise ConfigError("scenario", f"ground.holds.{rule}", f"{_MOST} points at most", f"some {number:.3g}")


def _spread(length: float, pitch: float) -> np.ndarray:
    """Places (n,) m along a length, as far apart as the pitch, from end to end where it fits."""
    return np.arange(0, length + 1e-9, pitch)


def _placed(position: np.ndarray, corner: tuple[float, float]) -> np.ndarray:
    """Positions from the corner of their area, in the world."""
    return np.asarray(position + np.array([*corner, 0.0]))

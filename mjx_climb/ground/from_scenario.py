"""The points of a scenario that can be held, from a list, a file, a height map or a rule."""

import difflib
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from mjx_climb.arrays import AnyArray
from mjx_climb.ground import rules
from mjx_climb.ground.height_map import holdable
from mjx_climb.ground.holds import Holds, of
from mjx_climb.ground.readers import table_of
from mjx_climb.reading import until_edited
from mjx_climb.scenario import model
from mjx_climb.scenario.messages import ConfigError
from mjx_climb.scenario.values import MAX_COUNT

# names of normals in files, of ROS and PLY, and of PCL
_NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
_LEVEL = 0.1  # of the height of a unit vector: nearer to level it counts as neither up nor down
_FARTHEST = 1e9  # m, of a coordinate
_NEAR = 9  # points of a file among which one is looked for above another

# positions (n, 3) m, normals (n, 3) 1, limits (n,) N; NaN marks a point without a limit of its own
_Found = tuple[np.ndarray, np.ndarray, np.ndarray]


def _files(ground: model.Ground) -> list[str | None]:
    source = None if ground.holds is None else ground.holds.source[1]
    return [getattr(source, name, None) for name in ("file", "mask")]


@until_edited(_files)
def holds_of(ground: model.Ground) -> Holds | None:
    """The points of a ground that can be held; None: it can be held everywhere.

    Raises:
        ConfigError: in one line with file and key, an unreadable file, too many points, or none.
    """
    if (section := ground.holds) is None:
        return None
    name, source = section.source
    random, key = np.random.default_rng(section.seed), f"ground.holds.{name}"
    turn, place = _rotation(*section.turn), getattr(source, "file", "scenario")
    # infinite numbers are refused below
    with np.errstate(all="ignore"):
        position, normal, limit = _FOUND[name](source, random, turn)
    if not (np.abs(position) <= _FARTHEST).all():
        raise ConfigError(place, key, f"finite positions, {_FARTHEST:g} m at most", "others")
    if section.limit is not None:
        limit = np.where(np.isnan(limit), section.limit, limit)
    limit = limit * np.exp(section.spread * random.standard_normal(limit.size))
    kept = _thinned(position, limit, section.spacing)
    if not kept.size:
        raise ConfigError(place, key, "one point that can be held", "none")
    if kept.size > (most := section.count or MAX_COUNT):
        key = "ground.holds.count" if section.count else key
        raise ConfigError(place, key, f"{most} points at most (ground.holds.spacing thins them out)", str(kept.size))
    shape = section.polyhedron
    return of(
        position[kept] @ turn.T + section.at,
        normal[kept] @ turn.T,
        None if np.isnan(limit).all() else np.where(np.isnan(limit), np.inf, limit)[kept],
        None if shape is None else (np.array(shape.matrix), np.array(shape.bound)),
        section.count,
    )


def holds_of_seeds(ground: model.Ground, seeds: Sequence[int]) -> Holds:
    """The points of a ground under several seeds, with a batch axis in front, all padded to the largest number.

    Raises:
        ConfigError: as `holds_of`.
        ValueError: a ground that can be held everywhere.
    """
    if (section := ground.holds) is None:
        raise ValueError("ground.holds: expected points that can be held, got none")

    def each(count: int | None) -> list[Holds | None]:
        changed = [section.model_copy(update={"seed": seed, "count": count}) for seed in seeds]
        return [holds_of(ground.model_copy(update={"holds": one})) for one in changed]

    most = max(len(holds.position) for holds in each(section.count) if holds is not None)
    made: dict[str, AnyArray] = {
        name: np.stack([getattr(holds, name) for holds in each(most)]) for name in Holds.VALUES
    }
    return Holds(**made)


def _listed(points: tuple[model.Hold, ...], random: np.random.Generator, turn: np.ndarray) -> _Found:
    limits = [np.nan if each.limit is None else each.limit for each in points]
    return np.array([each.at for each in points]), np.array([each.normal for each in points]), np.array(limits)


def _from_file(cloud: model.HoldCloud, random: np.random.Generator, turn: np.ndarray) -> _Found:
    table = table_of(cloud.file, cloud.topic)
    position = table.values(*"xyz")
    if (far := np.abs(position) > _FARTHEST).any():
        expected = f"{_FARTHEST:g} m at most, or nan for a gap"
        raise ConfigError(cloud.file, "x, y, z", expected, f"{position[far][0]:g}")
    there, origin = ~np.isnan(position).any(1), (position == 0).all(1)
    named = next((names for names in _NORMALS if {*names} <= {*table.names}), None)
    doubts = [*_misspelt(table.names, cloud.limit, named)]
    if origin.sum() > 1:
        there &= ~origin
        doubts.append(f"{origin.sum()} of {len(position)} points are at 0, 0, 0, as of no echo: left out")
    position = position[there]
    normal = table.values(*named)[there] if named else np.zeros_like(position)
    # programs write zeros or nan where they know none
    lacking = ~np.isfinite(normal).all(1) | (normal == 0).all(1)
    if lacking.any():
        fitted, side = _fitted(position, cloud.neighbours, turn, table.viewpoint)
        normal[lacking] = fitted[lacking]
        level = lacking & (side < _LEVEL)
        if level.any() and table.viewpoint is None:
            text = "fitted normals are level, so that their side is a guess (turn, or nx, ny, nz in the file)"
            doubts.append(f"{level.sum()} of {len(position)} {text}")
    if inward := _inward(position @ turn.T, normal @ turn.T):
        doubts.append(f"{inward} of {len(position)} normals look down, into the ground")
    # once for all copies of a file
    for text in doubts:
        warnings.warn(f"{Path(cloud.file).name}: ground.holds.cloud: {text}", stacklevel=2)
    limit = np.full(len(position), np.nan)
    if cloud.limit is not None or "limit" in table.names:
        name = cloud.limit or "limit"
        limit = cloud.limit_unit * table.values(name)[there, 0]
        if not (limit >= 0).all():
            got = f"nan at {np.isnan(limit).sum()} points" if np.isnan(limit).any() else f"{limit.min():g}"
            raise ConfigError(cloud.file, name, "limits of 0 or above", got)
    return position, normal, limit


def _on_map(ground: model.HoldMap, random: np.random.Generator, turn: np.ndarray) -> _Found:
    position, normal = holdable(ground)
    return position, normal, np.full(len(position), np.nan)


def _by_rule(rule: Callable[..., rules.Points]) -> Callable[..., _Found]:
    def found(source: object, random: np.random.Generator, turn: np.ndarray) -> _Found:
        position, normal = rule(source, random)
        return position, normal, np.full(len(position), np.nan)

    return found


_FOUND: dict[str, Callable[..., _Found]] = {
    "points": _listed,
    "cloud": _from_file,
    "map": _on_map,
    **{name: _by_rule(getattr(rules, name)) for name in ("handrails", "truss", "pipe", "wall", "rock")},
}


def _misspelt(names: Sequence[str], limit: str | None, normals: tuple[str, ...] | None) -> Iterator[str]:
    """A line for each column whose name is nearly one that would be read."""
    known = [name for each in ([] if normals else _NORMALS) for name in each] + ["limit"] * (limit is None)
    for name in names:
        near = difflib.get_close_matches(name.lower(), known, 1, 0.8)
        if near and name != "limit":
            yield f"column {name} is not read: expected {', '.join(next((n for n in _NORMALS if near[0] in n), near))}"


def _fitted(
    position: np.ndarray, neighbours: int, turn: np.ndarray, viewpoint: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Normals (n, 3) of planes through the nearest points, out of the ground, and cosines (n,) to there.

    They are up where these points are on a line. Out is towards the viewpoint, or else up after the turn (3, 3). On
    ground that the turn makes a wall it is also along the file's z.
    """
    from scipy.spatial import cKDTree

    up = np.tile(turn[2], (len(position), 1))
    if min(neighbours, len(position)) < 3:
        return up, np.ones(len(position))
    _, near = cKDTree(position).query(position, min(neighbours, len(position)))
    around = position[near] - position[near].mean(1, keepdims=True)
    spread, axes = np.linalg.eigh(around.mT @ around)
    normal = np.where(spread[:, 1:2] > 1e-6 * spread[:, 2:], axes[..., 0], up)
    ahead = np.array([0.0, 0.0, turn[2, 2] > -_LEVEL])
    out = up + ahead if viewpoint is None else viewpoint - position
    cosine = (normal * out).sum(1) / np.linalg.norm(out, axis=1)
    return np.where(cosine[:, None] < 0, -normal, normal), np.abs(cosine)


def _inward(position: np.ndarray, normal: np.ndarray) -> int:
    """The number of normals (n, 3) that look down at points (n, 3) with no other above, as below an overhang."""
    from scipy.spatial import cKDTree

    down = position[normal[:, 2] < -_LEVEL * np.linalg.norm(normal, axis=1)]
    if not down.size:
        return 0
    across, near = cKDTree(position[:, :2]).query(down[:, :2], range(1, min(len(position), _NEAR) + 1))
    above = position[near, 2] - down[:, 2:] > 2 * across + 1e-3
    return int((~above.any(1)).sum())


def _thinned(position: np.ndarray, limit: np.ndarray, spacing: float) -> np.ndarray:
    """The numbers of the points that stay, (n,), in their order: of each cube the one with the largest limit."""
    if not spacing:
        return np.arange(len(position))
    best_first = np.argsort(-np.nan_to_num(limit, nan=np.inf), kind="stable")
    _, first = np.unique(np.floor(position[best_first] / spacing), axis=0, return_index=True)
    return np.sort(best_first[first])


def _rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """The rotation (3, 3) by roll about x, then pitch about y, then yaw about z, axes that stay."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix())

"""Grounds by rule, thinned, turned and padded, against loops over their points by the words of the reference."""

import itertools
import math
import warnings

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mjx_climb.ground import holds_of, holds_of_seeds
from mjx_climb.scenario.model import Ground

UP = (0.0, 0.0, 1.0)


def along(length, pitch):
    """Places from 0 on, a pitch apart."""
    return [n * pitch for n in range(math.floor(length / pitch + 1e-7) + 1)]


def handrails(of, random):
    (length, width), rails = of["size"], of["rails"]
    places = [width * n / (rails - 1) for n in range(rails)] if rails > 1 else [width / 2]
    return [((x, y, 0.0), UP) for y in places for x in along(length, of["pitch"])]


def pipe(of, random):
    (length, width), radius, found = of["size"], of["radius"], []
    for x in along(length, of["pitch"]):
        for n in range(of["around"]):
            y, z = math.sin(2 * math.pi * n / of["around"]), math.cos(2 * math.pi * n / of["around"])
            found.append(((x, width / 2 + radius * y, radius * (z - 1)), (0.0, y, z)))
    return found


def wall(of, random):
    (length, width), pitch, found = of["size"], of["pitch"], []
    rows, columns = along(width, pitch), along(length, pitch)
    heights, tilts = random.random((len(rows), len(columns))), random.standard_normal((len(rows), len(columns), 2))
    filled = random.random((len(rows), len(columns)))
    for (n, y), (m, x) in itertools.product(enumerate(rows), enumerate(columns)):
        x += pitch / 2 * (n % 2)
        a, b = (max(-1.5, min(of["tilt"] * each, 1.5)) for each in tilts[n, m])
        if x <= length + 1e-9 and filled[n, m] < of["filled"]:
            found.append(((x, y, of["height"] * heights[n, m]), (math.tan(a), math.tan(b), 1.0)))
    return found


def rock(of, random):
    (length, width), found = of["size"], []
    count = round(of["density"] * length * width)
    places, lengths = random.random((count, 2)) * [length, width], of["wavelength"] / 8 ** random.random(24)
    ways, phases = 2 * np.pi * random.random((2, 24))
    # half the squares of amplitudes add up to the variance of heights; amplitudes are in proportion to lengths
    share = of["roughness"] / math.sqrt(sum(each**2 for each in lengths) / 2)
    for x, y in places:
        z = slope_x = slope_y = 0.0
        for wave, way, phase in zip(lengths, ways, phases, strict=True):
            number = 2 * math.pi / wave
            angle = number * (x * math.cos(way) + y * math.sin(way)) + phase
            z += share * wave * math.cos(angle)
            slope_x -= share * wave * number * math.cos(way) * math.sin(angle)
            slope_y -= share * wave * number * math.sin(way) * math.sin(angle)
        found.append(((x, y, z), (-slope_x, -slope_y, 1.0)))
    return found


def lattice(length, width, bay, pitch):
    """Nodes, then the points inside chords, battens and diagonals; all members of a kind have as many."""
    columns, rows = max(round(length / bay), 1), max(round(width / bay), 1)
    node = {
        (n, m): np.array([length * m / columns, width * n / rows]) for n in range(rows + 1) for m in range(columns + 1)
    }
    chords = [(node[n, m], node[n, m + 1]) for n in range(rows + 1) for m in range(columns)]
    battens = [(node[n, m], node[n + 1, m]) for n in range(rows) for m in range(columns + 1)]
    diagonals = [
        (node[n, m], node[n + 1, m + 1]) if (n + m) % 2 == 0 else (node[n + 1, m], node[n, m + 1])
        for n in range(rows) for m in range(columns)
    ]  # fmt: skip
    found = [tuple(each) for each in node.values()]
    for members in (chords, battens, diagonals):
        pieces = max(math.ceil(max(math.dist(a, b) for a, b in members) / pitch - 1e-9), 1)
        found += [tuple(a + n / pieces * (b - a)) for n in range(1, pieces) for a, b in members]
    return found


def truss(of, random):
    (length, width), depth, bay, pitch = of["size"], of["depth"], of["bay"], of["pitch"]
    found = [((x, s, 0.0), UP) for x, s in lattice(length, width, bay, pitch)]
    if depth:
        found += [((x, 0.0, -s), (0.0, -1.0, 0.0)) for x, s in lattice(length, depth, bay, pitch)]
        found += [((x, width, s - depth), (0.0, 1.0, 0.0)) for x, s in lattice(length, depth, bay, pitch)]
        found += [((x, width - s, -depth), (0.0, 0.0, -1.0)) for x, s in lattice(length, width, bay, pitch)]
    return found


RULES = {each.__name__: each for each in (handrails, pipe, wall, rock, truss)}


def drawn(rule, draw):
    area = {"size": draw.uniform(0.2, 1.5, 2).round(3).tolist(), "corner": draw.uniform(-1, 1, 2).tolist()}
    own = {
        "handrails": {"rails": int(draw.integers(1, 5)), "pitch": draw.choice([0.05, 0.11, 0.2])},
        "pipe": {"radius": draw.uniform(0.1, 1), "around": int(draw.integers(1, 12)), "pitch": 0.15},
        "wall": {"pitch": draw.choice([0.1, 0.07]), "filled": draw.choice([1.0, 0.6]), "height": draw.uniform(0, 0.1),
                 "tilt": draw.choice([0.0, 0.2, 2.0])},
        "rock": {"density": draw.uniform(20, 60), "roughness": 0.02, "wavelength": draw.uniform(0.2, 0.5)},
        "truss": {"bay": draw.choice([0.2, 0.5, 3.0]), "depth": draw.choice([0.0, 0.3]),
                  "pitch": draw.choice([0.06, 0.2, 2.0])},
    }[rule]  # fmt: skip
    polyhedron = {"matrix": [[0.0, 0.0, -1.0], [0.5, 0.0, -0.3]], "bound": [1.0, 0.0]}
    more = {
        "limit": draw.choice([None, 5.0]), "spread": draw.choice([0.0, 0.4]), "seed": int(draw.integers(9)),
        "spacing": draw.choice([0.0, 0.16]), "at": draw.uniform(-1, 1, 3).tolist(),
        "turn": draw.uniform(-3, 3, 3).tolist(), "polyhedron": draw.choice([None, polyhedron]),
    }  # fmt: skip
    return {rule: area | {k: v if isinstance(v, int) else float(v) for k, v in own.items()}, **more}


def by_hand(section, rule):
    """Positions, unit normals and limits in the world."""
    random = np.random.default_rng(section["seed"])
    of = section[rule]
    points = RULES[rule](of, random)
    limits = [np.nan if section["limit"] is None else section["limit"]] * len(points)
    limits = [
        each * math.exp(section["spread"] * draw)
        for each, draw in zip(limits, random.standard_normal(len(points)), strict=True)
    ]
    placed = [(np.add(at, [*of["corner"], 0.0]), np.array(normal)) for at, normal in points]
    kept = range(len(points))
    if section["spacing"]:
        best = {}
        for n, (at, _) in enumerate(placed):
            cube = tuple(math.floor(each / section["spacing"]) for each in at)
            if cube not in best or limits[n] > limits[best[cube]]:
                best[cube] = n
        kept = sorted(best.values())
    turn = Rotation.from_euler("x", section["turn"][0])
    turn = Rotation.from_euler("z", section["turn"][2]) * Rotation.from_euler("y", section["turn"][1]) * turn
    return [
        (turn.apply(placed[n][0]) + section["at"], turn.apply(placed[n][1]) / np.linalg.norm(placed[n][1]), limits[n])
        for n in kept
    ]


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("seed", range(4))
def test_points_of_a_rule_are_where_its_words_say(rule, seed):
    draw = np.random.default_rng((seed, len(rule)))
    section = drawn(rule, draw)
    expected = by_hand(section, rule)
    count, spare = len(expected), seed if draw.random() < 0.5 else None
    made = holds_of(Ground.model_validate({"holds": section | {"count": None if spare is None else count + spare}}))
    room = spare or 0
    assert made.valid.tolist() == [1.0] * count + [0.0] * room
    np.testing.assert_allclose(made.position[:count], [each[0] for each in expected], atol=1e-9)
    np.testing.assert_allclose(made.normal[:count], [each[1] for each in expected], atol=1e-9)
    np.testing.assert_array_equal(made.normal[count:], np.tile(UP, (room, 1)))
    shape = section["polyhedron"] or {"matrix": [[0.0, 0.0, -1.0]], "bound": [1.0]}
    rows = 0 if section["limit"] is None else len(shape["bound"])
    assert made.limit_matrix.shape == (count + room, rows, 3) and made.limit_bound.shape == (count + room, rows)
    if rows:
        bounds = [[limit * share for share in shape["bound"]] for *_, limit in expected]
        np.testing.assert_allclose(made.limit_bound, bounds + [[1.0] * rows] * room, rtol=1e-9)
        np.testing.assert_array_equal(made.limit_matrix[:count], [shape["matrix"]] * count)
        assert not made.limit_matrix[count:].any()


def test_grounds_of_seeds_are_those_of_each_seed_padded_to_the_largest():
    section = {"wall": {"size": [0.5, 0.4], "filled": 0.5}, "limit": 3.0, "spread": 0.2}
    ground = Ground.model_validate({"holds": section})
    seeds = [5, 0, 7]
    every = holds_of_seeds(ground, seeds)
    each = [holds_of(Ground.model_validate({"holds": section | {"seed": seed}})) for seed in seeds]
    most = max(len(one.position) for one in each)
    assert every.position.shape == (3, most, 3) and len({len(one.position) for one in each}) > 1
    for n, one in enumerate(each):
        count = len(one.position)
        assert every.valid[n].sum() == count
        for name in ("position", "normal", "limit_bound", "limit_matrix"):
            np.testing.assert_array_equal(getattr(every, name)[n, :count], getattr(one, name), err_msg=name)
    with pytest.raises(ValueError, match=r"ground.holds: expected points that can be held, got none"):
        holds_of_seeds(Ground.model_validate({}), seeds)


@pytest.mark.parametrize("seed", range(6))
def test_normals_that_a_file_lacks_are_those_of_the_nearest_points(seed, tmp_path):
    """Planes by the singular vectors of each point's neighbours, sought one by one."""
    draw = np.random.default_rng(seed)
    count, neighbours = 40, int(draw.choice([1, 2, 3, 6, 50]))
    line = seed == 4
    points = draw.uniform(-1, 1, (count, 3)) * ([1.0, 0, 0] if line else [1.0, 1.0, 0.15])
    given, known = np.add(draw.normal(size=(count, 3)), [0, 0, 2.0]), draw.random(count) < 0.5
    normals = np.where(known[:, None], given, draw.choice([0.0, np.nan]))
    limits = draw.uniform(0, 9, count)
    table = np.column_stack([points, normals, limits])
    gap = draw.random(count) < 0.1
    table[gap, int(draw.integers(3))] = np.nan
    header = "x,y,z,normal_x,normal_y,normal_z,strength" if seed % 2 else "x,y,z,nx,ny,nz,limit"
    np.savetxt(tmp_path / "cloud.csv", table, delimiter=",", header=header, comments="", fmt="%.17g")
    named, turn = ({"limit": "strength", "limit_unit": 2.0} if seed % 2 else {}), draw.uniform(-1.5, 1.5, 3)
    cloud = {"file": str(tmp_path / "cloud.csv"), "neighbours": neighbours, **named}
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        made = holds_of(Ground.model_validate({"holds": {"cloud": cloud, "turn": turn.tolist()}}))
    points, normals, known, limits = points[~gap], given[~gap], known[~gap], limits[~gap]
    turned = Rotation.from_euler("xyz", turn).as_matrix()
    out, level = turned[2] + [0, 0, 1.0 if turned[2, 2] > -0.1 else 0.0], 0
    for n, point in enumerate(points):
        if known[n]:
            continue
        normals[n] = turned[2]
        near = sorted(range(len(points)), key=lambda m, point=point: math.dist(points[m], point))[:neighbours]
        if len(near) > 2:
            _, sizes, axes = np.linalg.svd(points[near] - points[near].mean(0))
            if sizes[1] ** 2 > 1e-6 * sizes[0] ** 2:
                normals[n] = axes[2] if axes[2] @ out > 0 else -axes[2]
                level += abs(axes[2] @ out) < 0.1 * np.linalg.norm(out)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(made.normal, normals @ turned.T, atol=1e-6)
    np.testing.assert_allclose(made.position, points @ turned.T, atol=1e-12)
    np.testing.assert_allclose(made.limit_bound[:, 0], limits * named.get("limit_unit", 1.0))
    world, down = points @ turned.T, 0
    for at, normal in zip(world, normals @ turned.T, strict=True):
        nearest = sorted(world, key=lambda other, at=at: math.dist(other[:2], at[:2]))[:9]
        above = any(other[2] - at[2] > 2 * math.dist(other[:2], at[:2]) + 1e-3 for other in nearest)
        down += normal[2] < -0.1 and not above
    count, words = len(world), []
    if level:
        text = "fitted normals are level, so that their side is a guess (turn, or nx, ny, nz in the file)"
        words.append(f"{level} of {count} {text}")
    if down:
        words.append(f"{down} of {count} normals look down, into the ground")
    assert [str(each.message) for each in said] == [f"cloud.csv: ground.holds.cloud: {each}" for each in words]

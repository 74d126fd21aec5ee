"""Dividing an emitter into parts of equal importance: pieces of a surface, or of the sky."""

from __future__ import annotations

import heapq

import numpy as np

# How much more urgent it is to halve a part of a surface that faces all ways than a flat one of the same weight.
_BENT = 20.0


def surface_clusters(
    positions: np.ndarray, weights: np.ndarray, count: int, normals: np.ndarray | None = None, reach: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Divide pieces of a surface among ``count`` clusters that are compact and weigh about the same, by repeated halving.

    Args:
        positions, weights: (P, 3), (P,) > 0, P >= count.
        normals, reach: (P, 3), unit, and (P,): pieces around which facing two ways is as bad as being so far apart.
            None: clusters may reach around edges.

    Returns:
        Cluster of each piece, (P,) uint32, and the representative piece of each cluster, (count,) int64: the one nearest to the
        weighted mean of positions.
    """

    def urgency(members: np.ndarray) -> float:
        """Priority of a cluster to be halved next: the heaviest, and sooner where normals differ."""
        total = float(weights[members].sum())
        if normals is None:
            return total
        facing = float(np.linalg.norm((normals[members] * weights[members, None]).sum(0)))
        return total + _BENT * (total - facing)

    heap = [(-urgency(np.arange(len(positions))), 0, np.arange(len(positions)))]
    done: list[np.ndarray] = []
    for step in range(1, count):
        while len(heap[0][2]) == 1:
            done.append(heapq.heappop(heap)[2])
        _, _, members = heapq.heappop(heap)
        places = positions[members]
        if normals is not None and reach is not None:
            scale = np.average(reach[members], weights=weights[members])
            places = np.concatenate([places, scale * normals[members]], axis=1)
        axis = int(np.argmax(np.ptp(places, axis=0)))
        members = members[np.argsort(places[:, axis], kind="stable")]
        cut = _halfway(np.concatenate([[0.0], weights[members].cumsum()]))
        for k, part in enumerate((members[:cut], members[cut:])):
            # The second number keeps heaps from comparing arrays.
            heapq.heappush(heap, (-urgency(part), 2 * step + k, part))
    cluster = np.zeros(len(positions), np.uint32)
    best = np.zeros(count, np.int64)
    for k, members in enumerate([*done, *(entry[2] for entry in heap)]):
        cluster[members] = k
        mean = np.average(positions[members], axis=0, weights=weights[members])
        best[k] = members[np.argmin(((positions[members] - mean) ** 2).sum(-1))]
    return cluster, best


def facet_clusters(
    positions: np.ndarray, normals: np.ndarray, weights: np.ndarray, cluster: np.ndarray, count: int, reach: np.ndarray
) -> np.ndarray:
    """Divide each cluster of pieces into ``count`` facets that differ little in position and normal, whatever they weigh.

    Args:
        positions, normals, weights: (P, 3), (P, 3), unit, and (P,) >= 0.
        cluster: (P,) uint32.
        reach: (P,), distances at which opposite normals are as bad as being so far apart; at least the size of the cluster.

    Returns:
        Facet of each piece, (P,) uint32. Those of cluster c are ``c * count`` and the following; some are empty where a cluster
        has fewer pieces.
    """
    facet = cluster.astype(np.uint32) * np.uint32(count)
    if count == 1:
        return facet
    order = np.argsort(cluster, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(cluster[order])) + 1):
        share = weights[members] + 1e-12 * max(weights[members].max(), 1e-300)
        size = np.ptp(positions[members], axis=0).max()
        scale = max(float(np.average(reach[members], weights=share)), float(size))
        features = np.concatenate([positions[members], scale * normals[members]], axis=1)
        parts = [np.arange(len(members))]
        while len(parts) < count:
            moments = [_moment(features[part], share[part]) for part in parts]
            worst = int(np.argmax([moment for moment, _ in moments]))
            moment, before = moments[worst]
            if moment <= 0:
                break
            part = parts.pop(worst)
            parts += [part[before], part[~before]]
        for k, part in enumerate(parts):
            facet[members[part]] += np.uint32(k)
    return facet


def unevenness(positions: np.ndarray, normals: np.ndarray, weights: np.ndarray, facet: np.ndarray) -> float:
    """Standard deviation of normals from those of evenly bent sheets, the best of which is fitted to each facet.

    Arguments as in `facet_clusters`. Next to 0 for flat facets and pieces of spheres and cylinders.
    """
    deviation = 0.0
    order = np.argsort(facet, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(facet[order])) + 1):
        root = np.sqrt(weights[members])[:, None]
        places = np.concatenate([positions[members] - positions[members[0]], np.ones((len(members), 1))], axis=1) * root
        wanted = normals[members] * root
        fitted, *_ = np.linalg.lstsq(places, wanted, rcond=None)
        deviation += float(((wanted - places @ fitted) ** 2).sum())
    return float(np.sqrt(deviation / max(weights.sum(), 1e-300)))


def _moment(points: np.ndarray, weights: np.ndarray) -> tuple[float, np.ndarray]:
    """(second moment of points (P, D) along their longest axis, Bool (P,): which lie before the mean on it)."""
    centred = points - np.average(points, axis=0, weights=weights)
    moments, axes = np.linalg.eigh(centred.T @ (centred * weights[:, None]))
    before = centred @ axes[:, -1] < 0
    return (float(moments[-1]) if before.any() and not before.all() else 0.0), before


def sky_clusters(weights: np.ndarray, count: int) -> np.ndarray:
    """Divide a latitude-longitude image into ``count`` rectangles that weigh about the same, by repeated halving.

    weights (H, W) >= 0 with a positive sum, solid angle included; H * W >= count. Returns the cluster of each pixel, (H, W)
    uint32. Source: Debevec, "A Median Cut Algorithm for Light Probe Sampling", 2006.
    """
    height, width = weights.shape
    table = np.zeros((height + 1, width + 1))
    table[1:, 1:] = weights.cumsum(0).cumsum(1)

    def total(y0: int, y1: int, x0: int, x1: int) -> float:
        return float(table[y1, x1] - table[y0, x1] - table[y1, x0] + table[y0, x0])

    heap = [(-total(0, height, 0, width), 0, height, 0, width)]
    done: list[tuple[int, int, int, int]] = []
    while heap and len(heap) + len(done) < count:
        _, y0, y1, x0, x1 = heapq.heappop(heap)
        if y1 - y0 == 1 and x1 - x0 == 1:
            done.append((y0, y1, x0, x1))
            continue
        # The longer side on the sphere is cut, where either half has the same weight.
        breadth = (x1 - x0) * np.sin(np.pi * 0.5 * (y0 + y1) / height) * 2 * np.pi / width
        if x1 - x0 > 1 and (breadth >= (y1 - y0) * np.pi / height or y1 - y0 == 1):
            line = table[y1, x0 : x1 + 1] - table[y0, x0 : x1 + 1]
            cut = x0 + _halfway(line)
            parts = [(y0, y1, x0, cut), (y0, y1, cut, x1)]
        else:
            line = table[y0 : y1 + 1, x1] - table[y0 : y1 + 1, x0]
            cut = y0 + _halfway(line)
            parts = [(y0, cut, x0, x1), (cut, y1, x0, x1)]
        for part in parts:
            heapq.heappush(heap, (-total(*part), *part))
    cluster = np.zeros((height, width), np.uint32)
    for k, (y0, y1, x0, x1) in enumerate([*done, *(entry[1:] for entry in heap)]):
        cluster[y0:y1, x0:x1] = k
    return cluster


def _halfway(cumulative: np.ndarray) -> int:
    """Place where a rising line passes the middle between its ends: the nearest of its inner points."""
    middle = 0.5 * (cumulative[0] + cumulative[-1])
    return int(np.clip(np.argmin(np.abs(cumulative - middle)), 1, len(cumulative) - 2))

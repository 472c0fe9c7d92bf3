"""One PBNG sweep in plain NumPy float64, node after node: Eqs. (28)-(34) read aloud."""

import numpy as np
from models import cof, oracle_stress


def shape_gradients(X):
    """Gradients (n, corners, 3) of the shape functions, and rest volumes (n,), of simplices X (n, corners, 3)."""
    plane = X.shape[1] == 3
    edges = X[:, 1:] - X[:, :1]  # rows
    if plane:
        edges = np.concatenate([edges, np.broadcast_to([[[0.0, 0, 1]]], (len(X), 1, 3))], axis=1)
    G = np.linalg.inv(edges).transpose(0, 2, 1)  # row k: gradient of corner k + 1
    G = G[:, :2] if plane else G
    return np.concatenate([-G.sum(1, keepdims=True), G], axis=1), np.abs(np.linalg.det(edges)) / (2 if plane else 6)


def deformation(x, G):
    """F (n, 3, 3) of simplices x (n, corners, 3); F₃₃ = 1 in the plane."""
    F = np.einsum("nai,naj->nij", x, G)
    if x.shape[1] == 3:
        F[:, 2, 2] = 1
    return F


def sweep(problem, x, nodes, omega=1.0, paper=False):
    """x after the given nodes have been updated once each, in order."""
    x = np.array(x, float)
    geometry = [shape_gradients(problem.X[g.cells]) if g.kind.solid else None for g in problem.groups]
    for i in nodes:
        f, A = problem.f_ext[i].copy(), np.zeros((3, 3))
        for group, of_solid in zip(problem.groups, geometry):
            e, corner = np.nonzero(group.cells == i)
            if len(e) and of_solid is None:
                part = cloth(problem, group, x, e, np.eye(group.kind.corners)[corner], paper)
                f, A = f + part[0], A + part[1]
            elif len(e):
                G, V = of_solid
                a, b, at_rest = group.block(paper)
                F, g, v = deformation(x[group.cells[e]], G[e]), G[e, corner], V[e]
                c = g if at_rest else np.einsum("nij,nj->ni", cof(F), g)
                f -= np.einsum("n,nij,nj->i", v, oracle_stress(group.material, F), g)
                A += a * (v * (g * g).sum(1)).sum() * np.eye(3) + b * np.einsum("n,ni,nj->ij", v, c, c)
        target = 0
        for w in problem.weak:
            points = problem.targets(problem.end)[target:][: len(w.vertices)] if w.anchored else np.zeros((len(w.K), 3))
            target += len(points) * w.anchored
            for e, corner in zip(*np.nonzero(w.vertices == i)):
                C = w.weights[e] @ x[w.vertices[e]] - points[e]
                f -= w.weights[e, corner] * w.K[e] @ C
                A += w.weights[e, corner] ** 2 * w.K[e]
        x[i] += omega * np.linalg.solve(A, f)
    return x


def cloth(problem, group, x, e, beta, paper):
    """Force and block of elements e of a group of cloth on what moves their corners by the shares beta (n, corners)."""
    now, X = x[group.cells[e]], problem.X[group.cells[e]]
    return (hinge if group.kind.name == "hinge" else membrane)(group, now, X, beta, paper)


def membrane(group, x, X, beta, paper):
    """Eq. (36), F by the pseudo-inverse of the rest edges in a basis of their plane, R by an SVD."""
    a, b, _ = group.block(paper)
    f, A = np.zeros(3), np.zeros((3, 3))
    mu, lam = group.material.mu, group.material.lam
    for now, rest, share in zip(x, X, beta):
        edges = np.linalg.qr((rest[1:] - rest[0]).T)[1]
        K = np.linalg.inv(edges)
        area = abs(np.linalg.det(edges)) / 2
        F = (now[1:] - now[0]).T @ K
        g = (share[1:] - share[0]) @ K
        U, _, V = np.linalg.svd(F, full_matrices=False)
        m = np.cross(F[:, 0], F[:, 1])
        J, n = np.linalg.norm(m), m / np.linalg.norm(m)
        dJ = np.stack([np.cross(F[:, 1], n), np.cross(n, F[:, 0])], axis=1)
        f -= area * (2 * mu * (F - U @ V) + lam * (J - 1) * dJ) @ g
        v, c = g[0] * F[:, 1] - g[1] * F[:, 0], dJ @ g
        A += area * a * (g @ g) * np.eye(3)
        A += area * b * (np.outer(c, c) if paper else v @ v * np.eye(3) - np.outer(v, v))
    return f, A


def hinge(group, x, X, beta, paper):
    """Eqs. (35)-(37), the gradient by heights and cotangents."""
    f, A = np.zeros(3), np.zeros((3, 3))
    for now, rest, share in zip(x, X, beta):
        theta, gradient, c = angle(now)
        theta0 = angle(rest)[0] if group.kind.curved else 0.0
        e = rest[1] - rest[0]
        area = sum(np.linalg.norm(np.cross(e, rest[k] - rest[0])) / 2 for k in (2, 3))
        w = (3 * e @ e / area if group.kind.weighted else 1.0) * group.material.k
        g = share @ gradient
        theta = (theta - theta0 + np.pi) % (2 * np.pi) - np.pi
        f -= w * theta * g
        A += w * np.outer(g, g)
        if not paper:
            A += w * abs(theta) * (abs(share) @ c) ** 2 * np.eye(3)
    return f, A


def angle(x):
    """The angle of one hinge x (4, 3), its gradient (4, 3), and the roots (4,) of the bounds of its curvature."""
    x0, x1, x2, x3 = x
    n1, n2 = np.cross(x1 - x0, x2 - x0), np.cross(x3 - x0, x1 - x0)
    L, A1, A2 = np.linalg.norm(x1 - x0), np.linalg.norm(n1), np.linalg.norm(n2)
    unit = (x1 - x0) / L
    gradient = np.stack(
        [
            (x0 - x1) @ (x2 - x1) / A1 * n1 / A1 / L + (x0 - x1) @ (x3 - x1) / A2 * n2 / A2 / L,
            (x1 - x0) @ (x2 - x0) / A1 * n1 / A1 / L + (x1 - x0) @ (x3 - x0) / A2 * n2 / A2 / L,
            -L * n1 / A1**2,
            -L * n2 / A2**2,
        ]
    )
    ends = [np.hypot(np.linalg.norm(x2 - y) / A1, np.linalg.norm(x3 - y) / A2) for y in (x1, x0)]
    return np.arctan2(np.cross(n1, n2) @ unit, n1 @ n2), gradient, np.array([*ends, L / A1, L / A2])


def move_compound(problem, x, beta, omega=1.0):
    """x after a compound node, of whose movement vertex v takes part in the share beta[v], has been updated."""
    f, A = beta @ (problem.f_ext + problem.forces(x)), np.zeros((3, 3))
    for group in problem.groups:
        if not group.kind.solid:
            share = beta[group.cells]
            A += cloth(problem, group, x, slice(None), share - share.mean(1, keepdims=True), False)[1]
            continue
        G, V = shape_gradients(problem.X[group.cells])
        a, b, at_rest = group.block()
        g = np.einsum("na,naj->nj", beta[group.cells], G)
        c = g if at_rest else np.einsum("nij,nj->ni", cof(deformation(x[group.cells], G)), g)
        A += a * (V * (g * g).sum(1)).sum() * np.eye(3) + b * np.einsum("n,ni,nj->ij", V, c, c)
    for w in problem.weak:
        A += np.einsum("m,mij->ij", (w.weights * beta[w.vertices]).sum(1) ** 2, w.K)
    return x + omega * np.outer(beta, np.linalg.solve(A, f))


def energy_gradient(energy, x, direction, h):
    """Derivative of energy(x) along a direction, by differences of fourth order."""
    e = [energy(x + k * h * direction) for k in (-2, -1, 1, 2)]
    return (8 * (e[2] - e[1]) - (e[3] - e[0])) / (12 * h)

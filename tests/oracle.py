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
    geometry = [shape_gradients(problem.X[g.cells]) for g in problem.groups]
    for i in nodes:
        f, A = problem.f_ext[i].copy(), np.zeros((3, 3))
        for group, (G, V) in zip(problem.groups, geometry):
            e, corner = np.nonzero(group.cells == i)
            if len(e):
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


def move_compound(problem, x, beta, omega=1.0):
    """x after a compound node, of whose movement vertex v takes part in the share beta[v], has been updated."""
    f, A = beta @ (problem.f_ext + problem.forces(x)), np.zeros((3, 3))
    for group in problem.groups:
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

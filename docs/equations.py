"""List where each equation of the paper is computed: `python docs/equations.py` writes equations.md.

The line that computes an equation ends in a comment with its number, such as `Eq. 6`.
"""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "equations.md"
TAG = re.compile(r"# Eq\. (\d+)$")

WHAT = {
    1: "ZMP of a pendulum whose length changes, along x",
    2: "ZMP of the same pendulum, along y",
    3: "height of the CoM: oscillation of the spring",
    4: "vertical acceleration of the CoM",
    5: "central difference for the acceleration of the CoM",
    6: "tridiagonal system for the positions of the CoM",
    7: "Thomas algorithm: coefficients above the diagonal",
    8: "Thomas algorithm: right-hand side",
    9: "Thomas algorithm: back substitution",
    10: "bound on the relative entropy of a policy",
    11: "dual function of Eq. 10, for one context",
    12: "bound on the relative entropy for samples of contexts and parameters, and the optimal weights",
    13: "dual function of Eq. 12, of temperature and baseline",
    14: "coefficients of the policy's mean",
    15: "covariance of the policy, and Z",
    16: "normalised radial basis functions",
    17: "map parameters into their bounds by a sigmoid",
    18: "reward of a walk",
}
NOT_COMPUTED = {
    10: "not computed: the paper replaces it by Eq. 12",
    11: "not computed: the paper replaces it by Eq. 13",
}


def tagged() -> dict[int, list[str]]:
    """Return the places, `file:line`, that compute each equation."""
    places: dict[int, list[str]] = {number: [] for number in WHAT}
    for path in sorted((ROOT / "creps_jax").rglob("*.py")):
        for number, line in enumerate(path.read_text().splitlines(), start=1):
            found = TAG.search(line)
            if found:
                places[int(found[1])].append(f"{path.relative_to(ROOT)}:{number}")
    return places


def page() -> str:
    """Return the text of equations.md."""
    rows = []
    for number, places in tagged().items():
        where = ", ".join(f"`{place}`" for place in places) or NOT_COMPUTED[number]
        rows.append(f"| {number} | {WHAT[number]} | {where} |")
    return "\n".join(
        [
            "# Equations, and the lines that compute them",
            "",
            "The equations are those of Abdolmaleki et al. 2016. If the code uses a numerically safer form,",
            "or the printed equation has a misprint (see [Deviations](deviations.md)), a comment above the",
            "line shows the printed form.",
            "",
            "| equation | what it is | file and line |",
            "|---|---|---|",
            *rows,
            "",
        ]
    )


if __name__ == "__main__":
    PAGE.write_text(page())

"""The sanity checks of the physics: where each one is, and which faults turn it red.

Each check is a function `check_*` that a test runs once on the package (it passes) and once on each
planted fault (it fails; tests named `..._found_out`). The numbers are those of the
table of promises in docs/physics.md.

no  what                         check (file test_sanity_..., function)       planted faults
1   Beer and Lambert, scatter    extinction.check_beer_lambert                paper's opacities
2   counts, sizes, depths        population.check_counts                      N0 = 7600, rate
2   ... sizes                    population.check_sizes                       melted sizes, slope
2   ... depths                   population.check_depths                      even depths
3   explicit + residual = total  extinction.check_explicit_and_residual       veils, no fades
3   ... rendered                 extinction.check_rendered_walls              no veil
4   resolution                   extinction.check_resolution                  stock dilation
4   ... of the same discs        extinction.check_resolution_of_discs         stock dilation
5   streaks' axes                streaks.check_axes                           no turn, approach
5   ... parked                   streaks.check_parked                         no wind
5   ... focus of expansion       streaks.check_focus_of_expansion             no ego motion, middle
5   ... exposure                 streaks.check_exposure                       opacity at rest
6   exposure table               streaks.check_exposure_table                 opacity at rest
6   ... pixels                   streaks.check_pixel_sums                     opacity at rest
7   stationarity                 field.check_stationary                       paper's recycling
7   ... no repetition            field.check_no_repetition                    periodic box
8   random access                field.check_random_access                    stream, steps
8   ... two cameras              field.check_two_cameras                      field per camera
8   ... torch                    field.check_torch_path                       half precision
9   continuity                   motion.check_continuity                      wraps, wind * time
10  paper mode, parked           motion.check_parked_modes_agree              pose of now
10  ... driven                   motion.check_driven_sees_parked              turn about the origin
11  severity monotone            severity.check_monotone                      dip
11  ... thins                    severity.check_thinning                      re-roll
11  ... identity at 0            severity.check_identity                      base load
12  snow triangle                population.check_snow_triangle               N0, melted, Q, ends
13  fog contrast                 fog.check_contrast                           gamma, quadratic, 2 %
13  ... height fog               fog.check_height_fog                         even, surface, depth
13  ... its kernel               fog.check_kernel                             depth for range
13  ... sky                      fog.check_sky                                box of 80 m
14  Fresnel                      surfaces.check_fresnel                       Schlick
14  ... film                     surfaces.check_film                          fixed darkening
14  ... diffuse                  surfaces.check_diffuse                       dry film
14  ... mirror                   surfaces.check_mirror                        normals, even share
15  labels' ids                  labels.check_ids                             colours, mixed, snow
15  ... and classes              labels.check_never_from_the_picture          colours, snow
15  ... ignored grows            labels.check_ignored_grows                   re-roll, turns back
15  ... but not in moderate fog  labels.check_moderate_fog_hides_little       half hidden
16  sky rule                     severity.check_sky                           greys, dilation
"""

import ast
import re
from pathlib import Path

import pytest

ROWS = re.findall(r"^(\d+) .*?(\w+)\.(check_\w+)", __doc__, re.MULTILINE)
HERE = Path(__file__).parent


def test_every_number_has_a_row():
    assert {int(number) for number, _, _ in ROWS} == {*range(1, 17)}


@pytest.mark.parametrize(("number", "file", "name"), ROWS)
def test_each_check_runs_on_the_package_and_on_a_fault(number, file, name):
    """The table is true: the function exists, a test passes it, and a fault must fail it."""
    tree = ast.parse((HERE / f"test_sanity_{file}.py").read_text())
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    assert name in {node.name for node in functions}
    red, green = 0, 0
    for node in functions:
        if node.name.startswith(f"test_{number}_"):
            calls = {id(n) for n in ast.walk(node) if _calls(n, name)}
            raising = {
                id(n)
                for block in ast.walk(node)
                if isinstance(block, ast.With) and "raises" in ast.unparse(block.items[0])
                for n in ast.walk(block)
            }
            red += len(calls & raising)
            green += len(calls - raising)
    assert green > 0
    assert red > 0


def _calls(node, name):
    return isinstance(node, ast.Call) and getattr(node.func, "id", "") == name


def test_every_check_is_in_the_table():
    found = {
        (path.stem.removeprefix("test_sanity_"), node.name)
        for path in HERE.glob("test_sanity_*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("check_")
    }
    assert found == {(file, name) for _, file, name in ROWS}

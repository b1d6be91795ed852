"""The installed package: lazy import, float64, public names, bounded dependencies, shipped data.

Expected values are the public contract (names, files) and the rules of the packaging itself.
"""

from __future__ import annotations

import ast
import json
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import pytest

import gyromodel

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def python(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_importing_the_package_loads_nothing_heavy():
    code = "import gyromodel, sys, json; print(json.dumps(sorted(sys.modules)))"
    loaded = set(json.loads(python(code)))
    assert not loaded & {"jax", "equinox", "numpy", "pandas", "pint", "matplotlib", "yaml", "typer"}


@pytest.mark.parametrize("first", ["gyromodel, jax", "jax, gyromodel"])
def test_float64_is_on_whatever_is_imported_first(first: str):
    assert python(f"import {first}; import jax.numpy as jnp; print(jnp.zeros(1).dtype)") == "float64"


@pytest.mark.parametrize("name", gyromodel.__all__)
def test_every_public_name_exists(name: str):
    assert not isinstance(getattr(gyromodel, name), ModuleType)
    assert name in dir(gyromodel)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'fits'"):
        _ = gyromodel.fits


def test_type_checkers_see_the_same_names_as_users():
    tree = ast.parse(Path(gyromodel.__file__).read_text(encoding="utf-8"))
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    seen = {
        alias.asname: node.module.removeprefix("gyromodel.")
        for node in imports
        for alias in node.names
        if node.module.startswith("gyromodel.")
    }
    assert seen == gyromodel._MODULE_OF


def test_no_module_hides_a_public_name():
    """Importing a submodule binds its name on the package, over any function of that name."""
    assert not set(gyromodel._MODULE_OF) & {module.name for module in pkgutil.iter_modules(gyromodel.__path__)}


def test_diagnose_stays_a_function_after_its_room_was_imported():
    room = gyromodel._MODULE_OF["diagnose"]
    code = f"import gyromodel.{room}, gyromodel; print(callable(gyromodel.diagnose), callable(gyromodel.fit))"
    assert python(code) == "True True"


@pytest.mark.parametrize("name", ["report/template.html", "export/template.h", "data/ring_laser_table.csv", "py.typed"])
def test_data_files_are_shipped(name: str):
    assert (Path(gyromodel.__file__).parent / name).is_file()


def test_every_dependency_has_a_lower_and_an_upper_bound():
    extras = PROJECT["project"]["optional-dependencies"]
    requirements = PROJECT["project"]["dependencies"] + [r for extra in extras.values() for r in extra]
    requirements += PROJECT["build-system"]["requires"]
    for requirement in requirements:
        if not requirement.startswith("gyromodel["):
            assert re.fullmatch(r"[\w-]+>=[\d.]+,<[\d.]+", requirement), requirement


def test_imports_are_declared():
    """Every top-level import of the package is the standard library, the package itself or a dependency."""
    declared = {re.split(r"[<>=\[]", r)[0].lower() for r in PROJECT["project"]["dependencies"]}
    known = (
        sys.stdlib_module_names
        | {"gyromodel"}
        | {{"pyyaml": "yaml", "salib": "SALib"}.get(name, name) for name in declared}
    )
    for path in (ROOT / "gyromodel").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            assert {name.split(".")[0] for name in names} <= known, path


def test_the_change_log_opens_with_this_version():
    versions = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert versions[0] == gyromodel.__version__


def test_the_gate_runs_what_the_readme_tells_users_to_run():
    gate = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "\nmake test\n" in gate
    assert "make test" in (ROOT / "README.md").read_text(encoding="utf-8")

"""The package as a user gets it: what the wheel holds, which way imports run, what the README promises."""

import ast
import doctest
import importlib
import pathlib
import pkgutil
import re
import subprocess
import sys
import zipfile

import pytest

import warpgi as gi

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pytest brings it there

ROOT = pathlib.Path(__file__).resolve().parent.parent
PACKAGES = {
    "warpgi": "warpgi",
    "warpgi.methods": "warpgi/methods",
    "warpgi.kernels": "kernels",
    "warpgi.scenes": "scenes",
}


@pytest.fixture(scope="module")
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def sources(folder):
    return sorted(path for path in (ROOT / folder).glob("*.py"))


def test_packages_name_every_folder_with_code(project):
    """Every folder with Python code under the package's rooms is listed, or the wheel would lack it."""
    assert set(project["tool"]["setuptools"]["packages"]) == set(PACKAGES)
    folders = {
        path.parent.relative_to(ROOT).as_posix()
        for room in ("warpgi", "kernels", "scenes")
        for path in (ROOT / room).rglob("*.py")
    }
    assert folders == set(PACKAGES.values())


def test_wheel_holds_every_module(tmp_path):
    """The built wheel has each module of each package and the licence, and nothing of tests or bench."""
    pytest.importorskip("build", reason="the test extra brings it")
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--outdir", str(tmp_path), str(ROOT)],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {
        f"{package.replace('.', '/')}/{path.name}" for package, folder in PACKAGES.items() for path in sources(folder)
    }
    code = {name for name in names if name.endswith(".py")}
    assert code == expected
    assert any(name.endswith("LICENSE") for name in names)


def test_imports_run_one_way():
    """kernels know kernels alone, warpgi does not know scenes but for the door in its front, nobody says `kernels`."""
    allowed = {
        "kernels": ("warpgi.kernels",),
        "warpgi/methods": ("warpgi",),
        "warpgi": ("warpgi",),
        "scenes": ("warpgi",),
    }
    for folder, roots in allowed.items():
        for path in sources(folder):
            for node in ast.walk(ast.parse(path.read_text())):
                names = []
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom) and node.module:
                    names = [node.module]
                for name in names:
                    assert name.split(".")[0] not in ("kernels", "scenes", "bench", "tests"), (path, name)
                    if name.startswith("warpgi"):
                        assert name.startswith(roots), (path, name)
                    if folder.startswith("warpgi"):
                        assert not name.startswith("warpgi.scenes"), (path, name)


def test_public_names():
    """What `__all__` lists is there and documented."""
    for name in gi.__all__:
        assert getattr(gi, name).__doc__ or name == "METHODS", name


MODULES = [
    module.name
    for package in ("warpgi", "warpgi.methods", "warpgi.scenes")
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__, f"{package}.")
    if not module.ispkg and not module.name.endswith("__main__")
]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name):
    """Every example in a docstring gives what it says."""
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert result.failed == 0


def test_readme_snippets(tmp_path, monkeypatch):
    """The README's Python runs as it stands, one block after the other."""
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert blocks
    names: dict = {}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)


def test_readme_pictures_have_their_commands():
    """Every picture in the README exists and the command that made it stands there."""
    text = (ROOT / "README.md").read_text()
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    assert pictures
    for picture in pictures:
        assert (ROOT / picture).is_file()
        assert re.search(rf"--(out|picture) {re.escape(picture)}\b", text), picture


def test_ci_runs_the_readmes_test_command():
    """`.ci/run` installs and tests with the very command that the README gives."""
    command = next(line for line in (ROOT / "README.md").read_text().splitlines() if "pytest" in line and "pip" in line)
    assert command.strip() in (ROOT / ".ci" / "run").read_text()

"""Build the site: live pages of the gallery, the pages of the repository, notebooks, API.

python notebooks/site/build.py [--cases all]     writes notebooks/site/_build/html; a warning fails
"""

import argparse
import shutil
import subprocess
import sys
import time

import conf
import jax

import jaxtank
import tuning
from jaxtank import presets

BUILD = conf.HERE / "_build"
GALLERY = (
    "gouta2015/backstepping",
    "gouta2022/chadpc",
    "mirakhorli/hybrid",
    "calofir/backstepping",
    "cascaded/pi",
    "johansson/pi-minimum",
    "dts200/pi-faults",
)
"""One case of each rig that a page runs quickly."""


def gallery(names):
    """Write the live pages of cases and the page that lists them."""
    folder = BUILD / "extra" / "live"
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in names:
        file = name.replace("/", "-") + ".html"
        try:
            presets.find(name).explore().save(folder / file)
        except jaxtank.InputError as error:
            print(f"{name}: no live page ({error})", file=sys.stderr)
            continue
        rows.append(f"| <a href='live/{file}'>{name}</a> | {presets.find(name).title} |")
    text = (conf.HERE / "gallery.md").read_text()
    (BUILD / "pages" / "gallery.md").write_text("\n".join([text, "| case | |", "|---|---|", *rows]))


def api():
    """Write one page of names for each package."""
    for package in (jaxtank, tuning):
        name = package.__name__
        public = [n for n in sorted(package.__all__) if callable(getattr(package, n, None))]
        rows = "\n".join(f"   {n}" for n in public)
        text = f"# {name}\n\n```{{eval-rst}}\n.. currentmodule:: {name}\n\n.. autosummary::\n"
        text += f"   :toctree: api\n\n{rows}\n```\n"
        (BUILD / "pages" / f"api-{name}.md").write_text(text)


def pages():
    """Copy the pages of this folder and of the repository, with links that hold on the site."""
    target = BUILD / "pages"
    for file in [*conf.HERE.glob("*.md"), *conf.HERE.glob("howto/*.md")]:
        copy = target / file.relative_to(conf.HERE)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text(file.read_text())
    for page, name in conf.PAGES.items():
        (target / f"{name}.md").write_text(conf.moved((conf.ROOT / page).read_text(), page))
    (target / "notebooks").mkdir(exist_ok=True)
    for file in sorted((conf.ROOT / "notebooks").glob("*.ipynb")):
        shutil.copy(file, target / "notebooks" / file.name)


def main():
    """Build the site."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument(
        "--cases", nargs="*", default=GALLERY, help='cases of the gallery, or "all"'
    )
    chosen = options.parse_args().cases
    began = time.perf_counter()
    jax.config.update("jax_enable_x64", True)
    shutil.rmtree(BUILD, ignore_errors=True)
    (BUILD / "pages").mkdir(parents=True)
    pages()
    api()
    gallery(presets.names() if list(chosen) == ["all"] else chosen)
    command = ["-m", "sphinx", "-q", "-W", "--keep-going", "-c", str(conf.HERE)]
    command += [str(BUILD / "pages"), str(BUILD / "html")]
    failed = subprocess.run([sys.executable, *command], check=False).returncode
    print(f"{'failed' if failed else 'built'} in {time.perf_counter() - began:.0f} s: {BUILD}/html")
    return failed


if __name__ == "__main__":
    sys.exit(main())

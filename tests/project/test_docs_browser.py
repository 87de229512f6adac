"""The site in a browser, on a phone, a tablet and a desk, light and dark: all of a page can be seen."""

import subprocess
import sys

import pytest
from chromium import WEBGL_FLAGS, launch, open_page
from places import ROOT

for name in ("mkdocs", "material", "mkdocstrings_handlers"):
    pytest.importorskip(name, reason="the site is built with mkdocs: make docs")

WIDTHS = (390, 800, 1280)
PAGES = (
    "index",
    "install",
    "footprints",
    "performance",
    "accuracy",
    "command-line",
    "training",
    "api/index",
    "beside",
    "conventions",
    "troubleshooting",
    "gallery",
)
LEGIBLE = 550  # px, of a figure whose labels are made for a page of 700
SMALL = 340  # px, of one whose labels are made for a phone

FAULTS = """() => {
  const seen = element => element.getClientRects().length > 0;
  const scrolls = element => {
    for (let at = element; at; at = at.parentElement)
      if (/auto|scroll/.test(getComputedStyle(at).overflowX) && at.clientWidth <= innerWidth) return true;
    return false;
  };
  const found = [];
  const note = (what, element) => found.push(`${what}: ${(element.alt || element.textContent).slice(0, 40)}`);
  if (document.documentElement.scrollWidth > innerWidth) found.push("the page is wider than the screen");
  for (const element of document.querySelectorAll(".md-content :is(table, img, pre)")) {
    if (!seen(element)) continue;
    if (element.getBoundingClientRect().right > innerWidth && !scrolls(element)) note("cut off", element);
    if (element.tagName !== "IMG") continue;
    const least = element.matches(".small") ? SMALL : LEGIBLE;
    if (element.width < Math.min(least, element.naturalWidth)) note("too small", element);
    if (!element.complete) note("not loaded", element);
  }
  for (const element of document.querySelectorAll(".md-content td code"))
    if (seen(element) && element.getClientRects().length > 1) note("broken in a word", element);
  return found;
}""".replace("LEGIBLE", str(LEGIBLE)).replace("SMALL", str(SMALL))


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return folder


@pytest.fixture(scope="module")
def browser():
    with launch(WEBGL_FLAGS[:1]) as launched:
        yield launched


@pytest.mark.gate
@pytest.mark.parametrize("width", WIDTHS)
def test_pages_fit_on_the_screen(site, browser, width):
    faults = {}
    for name in PAGES:
        with open_page(browser, (site / f"{name}.html").as_uri(), size=(width, 800)) as page:
            faults[name] = page.evaluate(FAULTS)
    assert faults == {name: [] for name in PAGES}


@pytest.mark.gate
def test_what_is_too_wide_is_found(site, browser):
    """The test can fail."""
    with open_page(browser, (site / "performance.html").as_uri(), size=(390, 800)) as page:
        page.add_style_tag(content=".md-typeset__table, .md-typeset__scrollwrap { overflow: visible !important }")
        assert any(fault.startswith("cut off") for fault in page.evaluate(FAULTS))


@pytest.mark.gate
def test_plots_are_dark_on_a_dark_page(site, browser):
    with open_page(browser, (site / "performance.html").as_uri(), size=(800, 800), color_scheme="dark") as page:
        filters = page.evaluate("() => [...document.querySelectorAll('img.plot')].map(i => getComputedStyle(i).filter)")
    assert filters and all("invert" in each for each in filters)


@pytest.mark.gate
def test_a_divider_follows_the_mouse_and_the_keys(site, browser):
    """What is left of it is the photograph."""
    shown = "() => getComputedStyle(document.querySelector('.divided img + img')).clipPath"
    with open_page(browser, (site / "gallery.html").as_uri(), size=(800, 900)) as page:
        box = page.locator(".divided").first
        assert page.evaluate(shown).endswith("50%)")
        area = box.bounding_box()
        box.click(position={"x": 0.25 * area["width"], "y": 0.5 * area["height"]})
        left = float(page.evaluate(shown).split()[-1].rstrip("%)"))
        assert 20 < left < 30
        page.keyboard.press("ArrowRight")
        assert float(page.evaluate(shown).split()[-1].rstrip("%)")) == left + 1


def test_every_name_of_the_api_is_a_link(site):
    text = (site / "api" / "index.html").read_text()
    table = text[text.index("<table") : text.index("</table")]
    assert table.count("<code>") == table.count('autorefs-internal"') > 30


def test_no_two_pages_have_one_title(site):
    titles = [page.read_text().split("<title>")[1].split("</title>")[0] for page in site.rglob("*.html")]
    repeated = {title for title in titles if titles.count(title) > 1}
    assert repeated <= {"analytic_rasterizer"}  # the front page and 404.html

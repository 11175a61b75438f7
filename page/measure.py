"""How fast the page is: python page/measure.py URL, with the address that label or view printed.

Needs playwright (pip install playwright) and chromium; draws in software, as without a GPU.
"""

from __future__ import annotations

import shutil
import statistics
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright

FLAGS = ("--no-sandbox --disable-gpu --enable-unsafe-swiftshader --disable-quic --no-first-run "
         "--disable-background-networking --disable-component-update --disable-sync").split()
PICTURES = """async ([count, thinned]) => {
  const { drawn, fly, limits } = page, took = [];
  await new Promise((r) => setTimeout(r, 1000)); // at rest
  limits.thinned = thinned;
  for (let k = 0; k < count; k++) {
    const start = performance.now(), before = drawn.pictures;
    fly(0, 0, 0.02);
    while (drawn.pictures === before) await new Promise(requestAnimationFrame);
    await new Promise(requestAnimationFrame); // once it has been shown
    took.push(performance.now() - start);
  }
  limits.thinned = 30000;
  return { took, points: drawn.points };
}"""
PICKS = """(count) => {
  const took = [];
  for (let k = 0; k < count; k++) {
    const start = performance.now();
    page.pointAt(300 + 7 * (k % 80), 150 + 5 * (k % 70));
    took.push(performance.now() - start);
  }
  return { took, points: page.store.cloud.count };
}"""
NEXT = """async (count) => {
  const took = [];
  for (let k = 0; k < count; k++) {
    const goal = page.store.frame + 1;
    if (goal >= page.store.drive.frames.length) break;
    await new Promise((r) => setTimeout(r, 2500)); // as long as a person looks: the next is fetched
    const start = performance.now(), before = page.drawn.pictures;
    document.getElementById("next").click();
    while (page.store.frame !== goal || page.drawn.pictures === before) {
      await new Promise(requestAnimationFrame);
    }
    took.push(performance.now() - start);
  }
  return { took, points: page.store.cloud.count };
}"""


def renderers() -> dict[int, int]:
    """Memory of each of chromium's renderers by its process, bytes (proportional set size)."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if "--type=renderer" in (folder / "cmdline").read_text():
                line = next(x for x in (folder / "smaps_rollup").read_text().splitlines()
                            if x.startswith("Pss:"))
                found[int(folder.name)] = int(line.split()[1]) * 1024
        except (OSError, StopIteration):
            continue
    return found


def say(what: str, measured: dict) -> None:
    took = sorted(measured["took"])
    print(f"{what}, {measured['points']:,} points: median {statistics.median(took):.1f} ms, "
          f"slowest of {len(took)} {took[-1]:.1f} ms")


def main() -> None:
    others = set(renderers())
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.goto(sys.argv[1])
        page.wait_for_selector("html[data-ready=true]", state="attached")
        page.wait_for_timeout(1000)
        say("picture while moving", page.evaluate(PICTURES, [40, 30_000]))
        say("picture with all points", page.evaluate(PICTURES, [20, 10**9]))
        say("pick", page.evaluate(PICKS, 50))
        say("next frame", page.evaluate(NEXT, 12))
        for _ in range(80):
            page.keyboard.press(".")
            page.wait_for_timeout(60)
        page.wait_for_timeout(2000)
        mine = [size for pid, size in renderers().items() if pid not in others]
        print(f"memory of the page after {page.evaluate('page.store.frame') + 1} frames: "
              f"{max(mine) / 1e6:.0f} MB")
        browser.close()


if __name__ == "__main__":
    main()

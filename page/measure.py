"""Measure the speed of the page: python page/measure.py URL, where `label` or `view` has printed the URL.

This script requires chromium and playwright (pip install playwright). Drawing uses the CPU only.
"""

from __future__ import annotations

import os
import shutil
import statistics
import sys
from contextlib import suppress
from pathlib import Path
from time import monotonic

from playwright.sync_api import Page, sync_playwright

FLAGS = (
    "--no-sandbox --disable-gpu --enable-unsafe-swiftshader --disable-quic --no-first-run "
    "--disable-background-networking --disable-component-update --disable-sync"
).split()
DRAWING_SCRIPT = """async ([count, movingPoints]) => {
  const { drawStats, limits, moveCamera } = page, durations = [];
  await new Promise((r) => setTimeout(r, 1000)); // until the camera stands still
  limits.movingPoints = movingPoints;
  for (let k = 0; k < count; k++) {
    const start = performance.now(), before = drawStats.count;
    moveCamera(0, 0, 0.02);
    while (drawStats.count === before) await new Promise(requestAnimationFrame);
    await new Promise(requestAnimationFrame); // wait until it is shown
    durations.push(performance.now() - start);
  }
  limits.movingPoints = 30000;
  return { durations, points: drawStats.points };
}"""
REDRAWING_SCRIPT = """async (count) => {
  const { draw, drawStats } = page, durations = [];
  await new Promise((r) => setTimeout(r, 1000));
  for (let k = 0; k < count; k++) {
    const start = performance.now(), before = drawStats.count;
    draw(); // as after each step while a box is dragged
    while (drawStats.count === before) await new Promise(requestAnimationFrame);
    await new Promise(requestAnimationFrame);
    durations.push(performance.now() - start);
  }
  return { durations, points: drawStats.points };
}"""
PICKING_SCRIPT = """(count) => {
  const durations = [];
  for (let k = 0; k < count; k++) {
    const start = performance.now();
    page.findPointAt(300 + 7 * (k % 80), 150 + 5 * (k % 70));
    durations.push(performance.now() - start);
  }
  return { durations, points: page.store.cloud.count };
}"""
HOVER_SCRIPT = """async (count) => {
  const scene = document.getElementById("scene"), area = scene.getBoundingClientRect();
  const { cloud } = page.store, positions = new Map(), durations = [];
  for (let i = 0; i < cloud.count; i++) { // one point of each cluster in view
    if (!cloud.cluster[i] || positions.has(cloud.cluster[i])) continue;
    const position = page.project(...cloud.xyz.subarray(3 * i, 3 * i + 3));
    if (position && position[0] > 0 && position[1] > 0 && position[0] < area.width && position[1] < area.height) {
      positions.set(cloud.cluster[i], position);
    }
  }
  for (const [x, y] of [...positions.values()].slice(0, count)) {
    const start = performance.now(), before = page.drawStats.count;
    scene.dispatchEvent(new PointerEvent("pointermove",
                                         { clientX: area.left + x, clientY: area.top + y }));
    while (page.drawStats.count === before && performance.now() < start + 1000) {
      await new Promise(requestAnimationFrame);
    }
    await new Promise(requestAnimationFrame);
    if (page.drawStats.count !== before) durations.push(performance.now() - start);
  }
  return { durations, points: cloud.count };
}"""
NEXT_FRAME_SCRIPT = """async (count) => {
  const durations = [];
  for (let k = 0; k < count; k++) {
    const goal = page.store.frame + 1;
    if (goal >= page.store.drive.frames.length) break;
    await new Promise((r) => setTimeout(r, 2500)); // leave time to prefetch the next frame
    const start = performance.now(), before = page.drawStats.count;
    document.getElementById("next").click();
    while (page.store.frame !== goal || page.drawStats.count === before) {
      await new Promise(requestAnimationFrame);
    }
    durations.push(performance.now() - start);
  }
  return { durations, points: page.store.cloud.count };
}"""


def list_processes() -> dict[int, str]:
    """Return the kinds of all browser processes by id: "renderer", "gpu-process" or "" for others."""
    kinds = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            line = (folder / "cmdline").read_text()
            if "chromium" in line:
                kinds[int(folder.name)] = next(
                    (kind for kind in ("renderer", "gpu-process") if f"--type={kind}" in line), ""
                )
    return kinds


def read_cpu_ms(pid: int) -> float:
    """Return the CPU time of a process in milliseconds."""
    rows = (Path("/proc") / str(pid) / "stat").read_text().rsplit(")", 1)[1].split()
    return 1e3 * (int(rows[11]) + int(rows[12])) / os.sysconf("SC_CLK_TCK")


def read_memory(pid: int) -> int:
    """Return the proportional set size of a process in bytes."""
    lines = (Path("/proc") / str(pid) / "smaps_rollup").read_text().splitlines()
    return int(next(x for x in lines if x.startswith("Pss:")).split()[1]) * 1024


class MeasuredPage:
    """A page and the processes of its browser."""

    def __init__(self, page: Page, other_pids: set[int]) -> None:
        self.page = page
        kinds = {pid: kind for pid, kind in list_processes().items() if pid not in other_pids}
        self.page_pid = max((p for p, kind in kinds.items() if kind == "renderer"), key=read_memory)
        self.pids = {"page": self.page_pid, "drawing": next(p for p, kind in kinds.items() if kind == "gpu-process")}

    def measure(self, title: str, script: str, arguments: object) -> None:
        """Run a script that returns durations; print them and the mean CPU time of the page's processes."""
        start_ms = {name: read_cpu_ms(pid) for name, pid in self.pids.items()}
        result = self.page.evaluate(script, arguments)
        durations, count = sorted(result["durations"]), len(result["durations"])
        cpu = ", ".join(f"{name} {(read_cpu_ms(pid) - start_ms[name]) / count:.1f}" for name, pid in self.pids.items())
        print(
            f"{title}, {result['points']:,} points: median {statistics.median(durations):.1f} ms, "
            f"slowest of {count} {durations[-1]:.1f} ms; mean CPU time in ms: {cpu}",
            flush=True,
        )

    def measure_playback(self) -> None:
        """Play to the last frame; print the duration and the memory usage."""
        page, max_memory = self.page, 0
        first_frame, start = page.evaluate("page.store.frame"), monotonic()
        last_frame = page.evaluate("page.store.drive.frames.length - 1")
        page.locator("#scene").focus()
        page.keyboard.press(" ")
        while page.evaluate("page.store.frame") < last_frame:
            page.wait_for_timeout(1000)
            max_memory = max(max_memory, read_memory(self.page_pid))
        mean_ms = 1e3 * (monotonic() - start) / max(last_frame - first_frame, 1)
        page.wait_for_timeout(2000)
        print(
            f"played {last_frame - first_frame} frames, {mean_ms:.0f} ms each; memory of the page at most "
            f"{max_memory / 1e6:.0f} MB, at the end {read_memory(self.page_pid) / 1e6:.0f} MB"
        )


def main() -> None:
    other_pids = set(list_processes())
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.goto(sys.argv[1])
        page.wait_for_selector("html[data-ready=true]", state="attached")
        page.wait_for_timeout(2000)
        measured = MeasuredPage(page, other_pids)
        measured.measure("drawing while the camera moves", DRAWING_SCRIPT, [40, 30_000])
        measured.measure("drawing all points", DRAWING_SCRIPT, [20, 10**9])
        measured.measure("drawing while the camera stands still", REDRAWING_SCRIPT, 40)
        measured.measure("pick", PICKING_SCRIPT, 50)
        page.locator("#scene").focus()
        page.keyboard.press("s")
        measured.measure("highlighting the cluster under the pointer", HOVER_SCRIPT, 25)
        page.keyboard.press("Escape")
        measured.measure("next frame", NEXT_FRAME_SCRIPT, 12)
        measured.measure_playback()
        browser.close()


if __name__ == "__main__":
    main()

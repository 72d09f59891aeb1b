"""Time to redraw the explore page after a slider moves, in Chromium without a GPU.

Sample flight of two minutes in a window of 1400 by 900: time from the slider event to the end of
the frame with the new plots, for each setting; time of the replay; and size of the page. Prints
times and asserts nothing.

    python tests/benchmarks/bench_explore.py
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

LOG = Path(__file__).parents[2] / "sample_logs" / "aisle_uwb.ulg"
SCRIPT = """(async () => {
  const page = await Explore, slider = document.getElementById("%s"), whole = [], alone = [];
  const frame = () => new Promise((done) => requestAnimationFrame(() => setTimeout(done)));
  for (let move = 0; move < 60; move++) {
    await frame();
    await frame();
    slider.value = Number(slider.min) + (slider.max - slider.min) * (0.25 + move / 120);
    let start = performance.now();
    slider.dispatchEvent(new Event("input"));
    await frame();
    whole.push(performance.now() - start);
    start = performance.now();
    Engine.replay(page.flight, page.flight.axes[3], page.settings);
    alone.push(performance.now() - start);
  }
  const at = (values, share) => values.sort((a, b) => a - b)[Math.floor(share * 59)];
  return [at(whole, 0.5), at(whole, 0.95), at(alone, 0.5)];
})()"""


def main() -> None:
    from browser import BROWSERS, Browser
    from explore_tools import ask, show

    from px4fuse.diagnose import diagnose
    from px4fuse.explore.page import make_analysis_page
    from px4fuse.request import ComparisonRequest

    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        sys.exit("no Chromium or Chrome is installed")
    with tempfile.TemporaryDirectory() as folder:
        browser = Browser(program, Path(folder, "profile"))
        try:
            analysis = diagnose(ComparisonRequest(log=str(LOG)))
            file = Path(folder, "page.html")
            file.write_bytes(make_analysis_page(analysis).encode())
            show(browser, file)
            print(f"page: {file.stat().st_size / 1e6:.2f} MB")
            for knob in ("sigma-a", "sigma-z", "dt", "clock-offset"):
                median, most, alone = ask(browser, SCRIPT % knob)
                print(
                    f"  {knob}: {median:.0f} ms until redrawn (median), {most:.0f} ms (19 of "
                    f"20); the replay alone {alone:.1f} ms"
                )
        finally:
            browser.close()


if __name__ == "__main__":
    main()

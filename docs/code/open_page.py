"""Pictures of the page of `gbid open`: ``PYTHONPATH=tests/support python -m docs.code.open_page`` makes them anew."""

import threading
from importlib import import_module
from pathlib import Path

from devtools import Browser

from gbid.serve import open_bench

IMAGES = Path(__file__).parents[1].resolve() / "images"


def main() -> None:
    """Write the pictures, from the folder of a German logger."""
    import_module("docs.code.german_logger")  # makes the folder, and changes to its parent

    server, bench = open_bench(Path("Messungen"), Path("own"), 0, print)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    browser = Browser(Path("profile"))
    try:
        page = browser.page(server.address)
        page.until("document.body?.dataset.shown")
        page.click("document.getElementById('draft')")
        page.until("/nothing wrong: .* fits$/.test(document.getElementById('verdict').textContent)")
        page.click("[...document.querySelectorAll('#files button')][1]")
        page.until("document.body.dataset.shown.includes('prbs')")
        page.until("document.getElementById('verdict').className.endsWith('good')")
        page.picture(IMAGES / "open-plots.png", "document.getElementById('plots')")
        page.picture(IMAGES / "open-experiment.png", "document.getElementById('experiment')")
        page.click("document.getElementById('save')")
        narrow = browser.page(server.address, 400, dark=True)
        narrow.until("document.getElementById('verdict')?.className.endsWith('good')")
        narrow.picture(IMAGES / "open-choices-narrow.png", "document.getElementById('signals')")
    finally:
        browser.close()
        server.shutdown()
        bench.close()


if __name__ == "__main__":
    main()

"""A page in Debian's chromium, without a display or a network: runs a script in it and brings back what that found."""

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
_OPTIONS = (
    "--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--no-first-run", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--window-size=1400,1000", "--virtual-time-budget=60000",
    "--host-resolver-rules=MAP * ~NOTFOUND", "--dump-dom",
)  # fmt: skip
# Errors are kept from the first line of the page on; what the script finds takes the place of the page.
_BEFORE = """<script>
  window.complaints = [];
  addEventListener("error", event => complaints.push(event.message || "could not load " + event.target.src), true);
  addEventListener("unhandledrejection", event => complaints.push(String(event.reason)));
  console.error = (...said) => complaints.push(said.join(" "));
</script>"""
_AFTER = """<script>(async () => {
  const wait = time => new Promise(go => setTimeout(go, time));
  while (!document.documentElement.dataset.ready) await wait(20);
  const requests = performance.getEntriesByType("resource").map(entry => entry.name);
  let found;
  try { found = await (async () => { %s })(); } catch (error) { complaints.push(error.stack); }
  const told = JSON.stringify({found, complaints, requests});
  document.documentElement.innerHTML = "<pre></pre>";
  document.querySelector("pre").textContent = told;
})()</script>"""


def run_in_page(page: Path, script: str, scratch: Path) -> dict[str, Any]:
    """Open a copy of a page and run a script once it is drawn.

    Args:
        page: The page.
        script: Body of an async function; `wait(ms)` is there. It returns what is `found`.
        scratch: Folder for the copy and the browser's profile.

    Returns:
        `found`, `complaints` (errors of the page and of its console) and `requests` (files that it asked for).
    """
    text = page.read_text(encoding="utf-8")
    text = text.replace("<head>", "<head>" + _BEFORE, 1)
    end = text.rindex("</body>")
    copy = scratch / "page.html"
    copy.write_text(text[:end] + _AFTER % script + text[end:], encoding="utf-8")
    command = (CHROMIUM, *_OPTIONS, f"--user-data-dir={scratch / 'profile'}", copy.as_uri())
    done = subprocess.run(command, capture_output=True, text=True, timeout=180, check=True)
    told = re.search("<pre>(.*)</pre>", done.stdout, re.DOTALL)
    assert told, f"the page was not drawn in time: {done.stderr[-2000:]}"
    return json.loads(html.unescape(told[1]))

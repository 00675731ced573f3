# SPDX-License-Identifier: Apache-2.0

"""Pages in a real Chromium: opening them, and faults of their layout."""

from contextlib import contextmanager
import shutil

from needs import lack
from processes import PATIENCE
import pytest

CHROMIUM = next(
    filter(None, map(shutil.which, ('chromium', 'chromium-browser', 'google-chrome'))), None
)
NEEDS_CHROMIUM = pytest.mark.skipif(CHROMIUM is None, reason=lack('Chromium', 'chromium'))
WIDTHS = (480, 900, 1280)
"""Widths of a phone, a tablet and a laptop, pixels."""

FAULTS = r"""
() => {
  const faults = [], boxes = [];
  const visible = (e) => e.checkVisibility({visibilityProperty: true, opacityProperty: true});
  const add = (text, rect, of) => {
    const seen = rect.width > 1 && rect.height > 1;
    if (seen) { boxes.push({text: text.trim().slice(0, 40), rect, of}); }
  };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    const parent = node.parentElement;
    if (!node.textContent.trim() || parent.closest('script, style, select')) { continue; }
    if (/\d[eE][-+]\d/.test(node.textContent)) {
      faults.push('exponent: ' + node.textContent.trim().slice(0, 80));
    }
    if (parent.closest('svg') || !visible(parent)) { continue; }
    const range = document.createRange();
    range.selectNodeContents(node);
    for (const rect of range.getClientRects()) { add(node.textContent, rect, node); }
    for (let e = parent; e; e = e.parentElement) {
      if (getComputedStyle(e).overflowX !== 'visible' && e.scrollWidth > e.clientWidth + 1) {
        faults.push('cut: ' + node.textContent.trim().slice(0, 40));
      }
    }
  }
  for (const text of document.querySelectorAll('.plot svg text')) {
    const rect = text.getBoundingClientRect();
    if (!text.textContent.trim() || !visible(text)) { continue; }
    add(text.textContent, rect, text);
    const page = text.closest('svg.main-svg').getBoundingClientRect();
    if (rect.left < page.left - 1 || rect.right > page.right + 1 || rect.top < page.top - 1
        || rect.bottom > page.bottom + 1) {
      faults.push('cut in a plot: ' + text.textContent);
    }
  }
  for (let i = 0; i < boxes.length; i++) {
    for (let j = 0; j < i; j++) {
      const a = boxes[i].rect, b = boxes[j].rect;
      const wide = Math.min(a.right, b.right) - Math.max(a.left, b.left);
      const high = Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top);
      if (boxes[i].of !== boxes[j].of && wide > 2 && high > 4) {
        faults.push('overlap: ' + boxes[j].text + ' | ' + boxes[i].text);
      }
    }
  }
  if (document.documentElement.scrollWidth > innerWidth) {
    faults.push('wider than the window: ' + document.documentElement.scrollWidth);
  }
  return faults;
}
"""
"""Finds texts that overlap or are cut, numbers with an exponent, and a page that is too wide."""


@contextmanager
def running_browser():
    driver = pytest.importorskip(
        'playwright.sync_api', reason='playwright is not installed: pip install playwright'
    )
    with driver.sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=CHROMIUM, args=['--no-sandbox'])
        yield launched
        launched.close()


@contextmanager
def opener(browser):
    """Yield a function that opens a file, and returns the page and messages of the browser."""
    pages = []

    def begin(path, width=1366):
        page = browser.new_page(viewport={'width': width, 'height': 768})
        page.set_default_timeout(PATIENCE * 30_000)  # ms
        pages.append(page)
        messages = []
        page.on('console', lambda message: messages.append(f'{message.type}: {message.text}'))
        page.on('pageerror', lambda error: messages.append(f'error: {error}'))
        page.on(
            'request',
            lambda request: (
                messages.append(f'loads {request.url}')
                if not request.url.startswith(('data:', 'blob:', f'file://{path}'))
                else None
            ),
        )
        page.goto(f'file://{path}')
        return page, messages

    yield begin
    for page in pages:
        page.close()


def wait_until_drawn(page):
    page.wait_for_function('document.body.dataset.drawn === "yes"')


def layout_faults(page):
    """Return the faults of the layout of a page, in each of its tabs."""
    wait_until_drawn(page)
    faults = page.evaluate(FAULTS)
    for tab in page.locator('.tabs button').all():
        tab.click()
        faults += page.evaluate(FAULTS)
    return list(dict.fromkeys(faults))

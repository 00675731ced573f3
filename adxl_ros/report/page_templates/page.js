// Draws the figures of the page, switches its tabs and copies its commands.
'use strict';
(function () {
  function all(selector) { return Array.from(document.querySelectorAll(selector)); }

  async function library() {
    const packed = document.getElementById('plotly-js').textContent;
    const bytes = Uint8Array.from(atob(packed), function (c) { return c.charCodeAt(0); });
    const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
    const script = document.createElement('script');
    script.textContent = await new Response(stream).text();
    document.head.appendChild(script);
  }
  // With a view box, a printed plot shrinks to the width of the paper.
  function scalable(plot) {
    plot.querySelectorAll('.main-svg').forEach(function (svg) {
      svg.setAttribute('viewBox', '0 0 ' + svg.getAttribute('width') + ' ' + svg.getAttribute('height'));
    });
  }
  async function draw() {
    if (!document.getElementById('figures')) { return; }
    const figures = JSON.parse(document.getElementById('figures').textContent);
    const options = {responsive: true, displaylogo: false, displayModeBar: 'hover',
                     modeBarButtonsToRemove: ['lasso2d', 'select2d']};
    await library();
    for (const plot of all('.plot')) {
      const figure = figures[plot.dataset.figure];
      await window.Plotly.newPlot(plot, figure.data, figure.layout, options);
      scalable(plot);
      plot.on('plotly_afterplot', function () { scalable(plot); });
    }
  }
  function select(name) {
    all('.panel').forEach(function (panel) { panel.classList.toggle('hidden', panel.dataset.tab !== name); });
    all('.tabs button').forEach(function (button) {
      button.setAttribute('aria-selected', String(button.dataset.tab === name));
    });
  }
  async function copy(button) {
    const text = button.dataset.copy;
    try {
      await navigator.clipboard.writeText(text);
    } catch (error) {
      // A page of a file may have no clipboard; the old command copies a selection.
      const area = document.createElement('textarea');
      area.value = text;
      document.body.appendChild(area);
      area.select();
      document.execCommand('copy');
      area.remove();
    }
    button.textContent = 'copied';
    setTimeout(function () { button.textContent = 'copy'; }, 1500);
  }
  all('.tabs button').forEach(function (button) {
    button.addEventListener('click', function () { select(button.dataset.tab); });
  });
  all('a[data-tab]').forEach(function (link) {
    link.addEventListener('click', function () { select(link.dataset.tab); });
  });
  all('button[data-copy]').forEach(function (button) {
    button.addEventListener('click', function () { copy(button); });
  });
  const tabs = all('.tabs button');
  if (tabs.length) { select(tabs[0].dataset.tab); }
  draw().then(function () { document.body.dataset.drawn = 'yes'; }, function (error) {
    all('.plot').forEach(function (plot) {
      plot.className = 'missing';
      plot.textContent = 'This plot needs a browser of 2023 or later (' + error + ').';
    });
  });
}());

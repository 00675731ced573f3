// Residuals over the sphere of poses. Dragging or arrow keys turn it, the wheel zooms, and the pose
// under the pointer is named. Data: {models: [name], quantities: [[label, unit]], poses:
// [{u: [x, y, z], label, held_out, values: by model, by quantity, null where not shown}]}.
'use strict';
(function () {
  const data = JSON.parse(document.getElementById('sphere-data').textContent);
  const canvas = document.getElementById('sphere');
  const pen = canvas.getContext('2d');
  const model = document.getElementById('sphere-model');
  const quantity = document.getElementById('sphere-quantity');
  const about = document.getElementById('sphere-about');
  const SIZE = [640, 480], CENTRE = [245, 240], RADIUS = 190;
  let yaw = -0.7, pitch = 0.45, zoom = 1, drag = null, shown = [];

  function option(list, texts, chosen) {
    texts.forEach(function (text, i) { list.add(new Option(text, i, false, i === chosen)); });
  }
  option(model, data.models, data.models.length - 1);
  option(quantity, data.quantities.map(function (q) { return q[0] + ', ' + q[1]; }), 0);

  // At most three digits, and no exponent.
  function text(value) {
    return String(Number(value.toFixed(Math.abs(value) < 0.1 ? 4 : Math.abs(value) < 10 ? 3 : 1)));
  }
  function turned(u) {
    const a = Math.cos(yaw) * u[0] - Math.sin(yaw) * u[1];
    const b = Math.sin(yaw) * u[0] + Math.cos(yaw) * u[1];
    // Seen from the side: the second component is up, the third points to the viewer.
    return [a, Math.cos(pitch) * u[2] + Math.sin(pitch) * b,
            -Math.cos(pitch) * b + Math.sin(pitch) * u[2]];
  }
  function placed(v) {
    return [CENTRE[0] + RADIUS * zoom * v[0], CENTRE[1] - RADIUS * zoom * v[1]];
  }
  function colour(share) {
    // Blue, white, red: colour-blind people can distinguish them.
    const s = Math.max(-1, Math.min(1, share)), f = 1 - Math.abs(s);
    const end = s < 0 ? [33, 102, 172] : [178, 24, 43];
    const mixed = end.map(function (c) { return Math.round(c + (247 - c) * f); });
    return 'rgb(' + mixed.join(',') + ')';
  }
  function line(points) {
    [false, true].forEach(function (front) {
      pen.strokeStyle = front ? '#bbb' : '#eee';
      pen.beginPath();
      for (let i = 1; i < points.length; i++) {
        if ((points[i][2] > 0) !== front) { continue; }
        pen.moveTo.apply(pen, placed(points[i - 1]));
        pen.lineTo.apply(pen, placed(points[i]));
      }
      pen.stroke();
    });
  }
  function circle(make) {
    const points = [];
    for (let i = 0; i <= 72; i++) { points.push(turned(make(i * Math.PI / 36))); }
    line(points);
  }
  function values() {
    return data.poses.map(function (p) { return p.values[model.value][quantity.value]; });
  }
  function colourLimit(all) {
    const sizes = all.filter(function (v) { return v !== null; }).map(Math.abs);
    sizes.sort(function (a, b) { return a - b; });
    // One outlier must not make all other colours pale.
    return sizes.length ? sizes[Math.floor(0.95 * (sizes.length - 1))] || 1e-12 : 1;
  }
  function legend(largest, lowest, unit) {
    for (let i = 0; i < 200; i++) {
      pen.fillStyle = colour(1 - (1 - lowest) * i / 199);
      pen.fillRect(505, 130 + i, 22, 1.5);
    }
    pen.fillStyle = '#222';
    [[1, 140], [0, lowest < 0 ? 234 : 333], [-1, 333]].forEach(function (tick) {
      if (tick[0] < lowest) { return; }
      pen.fillText(text(tick[0] * largest) + ' ' + unit, 535, tick[1]);
    });
    pen.fillText('● fitted ■ held out', 495, 370);
    pen.fillText('× not determined', 495, 392);
  }
  function mark(point, size, largest) {
    const x = point.at[0], y = point.at[1];
    pen.strokeStyle = '#444';
    pen.beginPath();
    if (point.value === null) {
      pen.moveTo(x - size, y - size);
      pen.lineTo(x + size, y + size);
      pen.moveTo(x - size, y + size);
      pen.lineTo(x + size, y - size);
    } else if (point.pose.held_out) {
      pen.rect(x - size, y - size, 2 * size, 2 * size);
    } else {
      pen.arc(x, y, size, 0, 7);
    }
    if (point.value !== null) {
      pen.fillStyle = colour(point.value / largest);
      pen.fill();
    }
    pen.stroke();
  }
  function draw() {
    const ratio = window.devicePixelRatio > 2 ? window.devicePixelRatio : 2;
    canvas.width = SIZE[0] * ratio;
    canvas.height = SIZE[1] * ratio;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.font = '14px system-ui, sans-serif';
    pen.lineWidth = 1;
    for (let k = 0; k < 6; k++) {
      const t = k * Math.PI / 6;
      circle(function (s) {
        return [Math.sin(s) * Math.cos(t), Math.sin(s) * Math.sin(t), Math.cos(s)];
      });
    }
    [30, 60, 90, 120, 150].forEach(function (deg) {
      const a = deg * Math.PI / 180;
      circle(function (s) {
        return [Math.sin(a) * Math.cos(s), Math.sin(a) * Math.sin(s), Math.cos(a)];
      });
    });
    ['x', 'y', 'z'].forEach(function (name, i) {
      const end = [0, 0, 0];
      end[i] = 1.14;
      const tip = turned(end), at = placed(tip);
      pen.strokeStyle = pen.fillStyle = tip[2] > 0 ? '#222' : '#aaa';
      pen.beginPath();
      pen.moveTo.apply(pen, placed([0, 0, 0]));
      pen.lineTo.apply(pen, at);
      pen.stroke();
      pen.fillText(name + ' up', at[0] + 4, at[1] - 4);
    });
    const all = values(), largest = colourLimit(all), unit = data.quantities[quantity.value][1];
    shown = data.poses.map(function (pose, i) {
      const v = turned(pose.u);
      return {pose: pose, value: all[i], depth: v[2], at: placed(v)};
    });
    shown.sort(function (a, b) { return a.depth - b.depth; });
    shown.forEach(function (point) {
      pen.globalAlpha = point.depth > 0 ? 1 : 0.45;
      mark(point, point.depth > 0 ? 6 : 3.5, largest);
      pen.globalAlpha = 1;
    });
    legend(largest, all.some(function (v) { return v < 0; }) ? -1 : 0, unit);
    canvas.dataset.turn = yaw.toFixed(3) + ' ' + pitch.toFixed(3) + ' ' + zoom.toFixed(2);
  }
  function describe(event) {
    const box = canvas.getBoundingClientRect(), scale = SIZE[0] / box.width;
    const x = (event.clientX - box.left) * scale, y = (event.clientY - box.top) * scale;
    const near = shown.filter(function (point) {
      return point.depth > 0 && Math.hypot(point.at[0] - x, point.at[1] - y) < 10;
    }).pop();
    about.textContent = !near ? 'Drag to turn, wheel to zoom, point at a pose.' :
        near.pose.label + ': ' + (near.value === null ? 'not determined' :
            text(near.value) + ' ' + data.quantities[quantity.value][1]);
  }
  function turn(right, up) {
    yaw += right;
    pitch = Math.max(-1.57, Math.min(1.57, pitch + up));
    draw();
  }
  canvas.addEventListener('pointerdown', function (event) {
    drag = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener('pointermove', function (event) {
    if (drag) {
      turn((event.clientX - drag[0]) * 0.008, (event.clientY - drag[1]) * 0.008);
      drag = [event.clientX, event.clientY];
    }
    describe(event);
  });
  canvas.addEventListener('pointerup', function () { drag = null; });
  canvas.addEventListener('wheel', function (event) {
    event.preventDefault();
    zoom = Math.max(0.6, Math.min(4, zoom * Math.exp(-event.deltaY * 0.001)));
    draw();
  }, {passive: false});
  canvas.addEventListener('keydown', function (event) {
    const step = {ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1],
                  ArrowDown: [0, 0.1]}[event.key];
    if (step) {
      event.preventDefault();
      turn(step[0], step[1]);
    }
  });
  model.addEventListener('change', draw);
  quantity.addEventListener('change', draw);
  draw();
}());

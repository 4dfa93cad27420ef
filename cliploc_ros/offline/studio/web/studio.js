// SPDX-FileCopyrightText: 2026 the cliploc_ros authors
// SPDX-License-Identifier: Apache-2.0
// The page of the studio. It shows the parts that the server sends, and sends the user's actions.
// Texts of the map are inserted only as text nodes, never as HTML.
'use strict';

const $ = id => document.getElementById(id);
const SVG = 'http://www.w3.org/2000/svg';
const MODES = ['review', 'edit', 'create', 'test'];
// Greatest number of rows in the list. A search finds the other landmarks.
const MOST_ROWS = 300;
// Time between the pictures of the film, and their greatest number.
const PICTURE_MS = 200, MOST_PICTURES = 600;
const STEPS_M = [0.01, 0.05, 0.1, 0.5];
const person = Array.from(crypto.getRandomValues(new Uint8Array(12)),
                          byte => byte.toString(16).padStart(2, '0')).join('');
const base = location.pathname.replace(/[^/]*$/, '');
const state = {file: {}, rows: [], selection: {ids: [], one: null}, review: {}, log: {lines: []}, test: {}, layers: {},
               view: null, new: null};
let mode = 'review', socket = null, followed = null, step = 0.1, gesture = 0, wantsCheck = true, follows = false, film = null;
// Visible part of the image [px]; null: the whole image. A goal is applied once its view is shown.
let zoom = null, goal = null, shownView = -1, drag = null, typedNew = {};
const shares = {review: 0.6, edit: 0.5, create: 0.72, test: 0.5};

// ---- to and from the server

function send(name, values = {}) {
  // Keep a view that the user chose when the views of the selection arrive later.
  if (name === 'show_view' && state.selection?.one) followed = state.selection.one.id;
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify({do: name, ...values}));
}

function connect() {
  socket = new WebSocket(`${location.origin.replace(/^http/, 'ws')}${base}socket/${person}`);
  socket.onopen = () => { $('lost').hidden = true; };
  socket.onmessage = event => {
    const parts = JSON.parse(event.data);
    for (const [name, value] of parts) state[name] = value;
    show(new Set(parts.map(part => part[0])));
  };
  socket.onclose = () => { $('lost').hidden = false; setTimeout(connect, 500); };
}

// ---- making elements

function el(tag, props = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) {
    if (name.startsWith('on')) made.addEventListener(name.slice(2), value);
    else if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children.filter(child => child !== null));
  return made;
}

function drawn(tag, props) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(props)) made.setAttribute(name, value);
  return made;
}

function icon(name) {
  const made = drawn('svg', {});
  made.append(drawn('use', {href: `#i-${name}`}));
  return made;
}

function button(text, action, {key = '', kind = '', off = false, hint = ''} = {}) {
  return el('button', {className: kind, disabled: off, onclick: action,
                       title: hint + (key ? `${hint ? ' ' : ''}(${key})` : '')},
            text, key ? el('kbd', {}, key) : null);
}

const doing = (name, values) => () => send(name, values);
// People count from 1.
const viewName = view => `view ${view + 1}`;
const capital = text => text[0].toUpperCase() + text.slice(1);
const buttons = (...children) => el('div', {className: 'buttons'}, ...children);
const note = text => text ? el('p', {className: 'note'}, text) : null;

// An input field for a text or for numbers. Typed input is not overwritten until it is sent. Numbers
// are shown rounded, but keep their exact values unless they are edited.
function field(name, values, apply, {isText = false, isOff = false, digits = 3, list = '', of = ''} = {}) {
  const shown = values.map(value => isText ? value : String(Number(value.toFixed(digits))));
  const inputs = values.map((value, place) => el('input', {
    type: isText ? 'text' : 'number', step: 'any', value: shown[place], title: value,
    disabled: isOff, 'data-of': of,
    'aria-label': name + (values.length > 1 ? ` ${'xyz'[place]}` : ''),
    onchange: () => apply(isText ? inputs[0].value : inputs.map(
      (input, row) => input.value === shown[row] ? values[row] : Number(input.value))),
    onkeydown: event => { if (event.key === 'Enter') event.target.blur(); }}));
  if (list) inputs[0].setAttribute('list', list);
  return el('label', {className: `field${values.length > 1 ? ' three' : ''}`},
            el('span', {}, name), ...inputs);
}

// Replaces children. A focused field keeps the focus, and for the same landmark also its typed input.
function fill(where, children) {
  const active = document.activeElement;
  const name = where.contains(active) && active.tagName === 'INPUT' ? active.ariaLabel : null;
  where.replaceChildren(...children.filter(child => child !== null));
  const again = name && [...where.querySelectorAll('input')].find(input => input.ariaLabel === name);
  if (!again) return;
  again.focus();
  if (again.dataset.of !== active.dataset.of) { again.select(); return; }
  const shown = again.value;
  again.value = active.value;
  if (again.type === 'text') again.setSelectionRange(active.selectionStart, active.selectionEnd);
  again.addEventListener('blur', () => { if (again.isConnected && again.value !== shown) again.dispatchEvent(new Event('change')); }, {once: true});
}

// ---- showing the parts

function show(changed) {
  const has = (...names) => names.some(name => changed.has(name));
  if (has('file')) showFile();
  if (has('selection')) follow();
  if (has('selection', 'file')) showCard();
  if (has('selection', 'review', 'new', 'test', 'file', 'view', 'layers')) showPanel();
  if (has('rows', 'selection')) showRows();
  if (has('view', 'selection', 'new', 'file', 'rows')) showView();
  if (has('selection', 'view')) showStrip();
  if (has('layers', 'file')) showLayers();
  if (follows && has('view')) send('look_through');
  if (has('log')) showLog();
  if (has('people')) $('people').textContent = state.people > 1 ? `${state.people} pages share the selection and the view` : '';
  if (has('review')) {
    $('busy').textContent = (state.review.running || []).map(
      name => `${name.replaceAll('_', ' ')} ...`).join(' ');
    if (wantsCheck && state.rows.length && mode === 'review') {
      wantsCheck = false;
      if (state.review.total) selectNext();
      else if (!state.review.running.includes('check')) send('check');
    }
  }
}


function setMode(name) {
  mode = name;
  document.body.className = name;
  resize();
  fill($('modes'), MODES.map((one, place) => el('button', {
    'aria-pressed': String(one === name), onclick: () => setMode(one),
    title: `${one} (${place + 1})`}, capital(one))));
  if (mode === 'create') { send('select', {id: ''}); send('overview'); }
  if (mode === 'review') selectNext();
  if (state.file.name) show(new Set(Object.keys(state)));
}

// The review is about a landmark: without a selection, the first one without a decision.
function selectNext() {
  const next = state.rows.find(row => !row[6]);
  if (next && state.review.total && !state.selection.ids.length) send('select', {id: next[0]});
}

function resize() {
  $('view').style.flex = shares[mode];
  $('scene').style.flex = $('view').hidden ? 1 : 1 - shares[mode];
}

function showFile() {
  const file = state.file;
  fill($('name'), [el('b', {}, file.name), el('i', {}, file.is_saved ? '' : ' ●'),
                   el('small', {}, `${state.rows.length} landmarks in ${file.frame}; `
                      + (file.is_saved ? 'saved' : 'unsaved edits'))]);
  $('name').title = [file.name, ...file.notes].join('\n');
  document.title = `${file.is_saved ? '' : '● '}${file.name} - map studio`;
  $('save').className = file.is_saved ? '' : 'main';
  for (const name of ['undo', 'redo']) {
    const one = document.querySelector(`header [data-do=${name}]`);
    one.disabled = !file[name];
    one.title = `${capital(name)} ${file[name] || ''} (Ctrl-${name === 'undo' ? 'Z' : 'Y'})`;
  }
  $('conflict').hidden = !file.conflict;
  fill($('classes'), file.classes.map(value => el('option', {value})));
  if ($('view').hidden === Boolean(file.views)) {
    $('view').hidden = $('splitter').hidden = !file.views;
    resize();
  }
  $('slider').max = Math.max(0, file.views - 1);
}

// Shows the best view of a newly selected landmark, except in create mode.
function follow() {
  const one = state.selection.one;
  if (one?.id === followed) return;
  if (!one) { followed = null; return; }
  if (one.sightings) {
    followed = one.id;
    if (one.sightings.length && mode !== 'create') lookAt(one.sightings[0]);
  }
}

function lookAt([view, left, top, right, bottom]) {
  const [width, height] = state.view.size, wide = $('stage').clientWidth / $('stage').clientHeight;
  const h = Math.min(height, 3.2 * Math.max(bottom - top, (right - left) / wide)), w = h * wide;
  const within = (middle, size, whole) => size > whole ? (whole - size) / 2
    : Math.max(0, Math.min(whole - size, middle - size / 2));
  goal = {view, x: within((left + right) / 2, w, width), y: within((top + bottom) / 2, h, height), w, h};
  send('show_view', {view});
  if (state.view.view === view) showView();
}

function showCard() {
  const {ids, one} = state.selection;
  if (mode === 'create' || mode === 'test' || !ids.length) { fill($('card'), []); return; }
  if (!one) {
    fill($('card'), [el('div', {className: 'head'}, `${ids.length} selected`),
                     note(ids.slice(0, 20).join(', '))]);
    return;
  }
  const set = name => value => send('edit', {field: name, value, gesture: ++gesture});
  const off = {isOff: one.is_locked, of: one.id};
  fill($('card'), [
    el('div', {className: 'head'}, el('span', {}, one.id),
       toggle(one.is_locked ? 'locked' : 'open', one.is_locked ? 'Unlock' : 'Lock', 'L',
              doing('lock', {ids})),
       toggle('look', 'Look at the landmark', 'G', doing('look_at_landmark'))),
    field('Label', [one.label], set('label'), {isText: true, ...off}),
    mode === 'edit' && one.phrases.length ? el('div', {className: 'chips'}, ...one.phrases.map(
      text => button(text, () => set('label')(text), {off: one.is_locked, hint: text}))) : null,
    field('Class', [one.class_id], set('class_id'), {isText: true, list: 'classes', ...off}),
    ...(mode !== 'edit' ? [] : [
      field('Position', one.center, set('center'), off),
      field('Angles', one.angles, set('angles'), {...off, digits: 1}),
      field('Semi-axes', one.semi_axes, set('semi_axes'), off)])]);
}

function toggle(name, text, key, action) {
  return el('button', {className: 'icon', title: `${text} (${key})`, 'aria-label': text,
                       onclick: action}, icon(name));
}

const PANELS = {
  review() {
    const {total, accepted, fixed, deleted} = state.review, one = state.selection.one;
    const busy = state.review.running?.includes('check');
    if (!total) {
      return [note(busy ? 'The check compares the map with the recording.'
                        : 'The check sorts the landmarks, worst first.'),
              buttons(button('Check the map', doing('check'), {kind: 'main', off: busy}))];
    }
    const done = accepted + fixed + deleted;
    return [
      el('progress', {max: total, value: done}),
      note(`${done} of ${total}: ${accepted} accepted, ${fixed} fixed, ${deleted} deleted`),
      buttons(button('Accept', doing('accept'), {key: 'A', kind: 'main', off: !one}),
              button('Fix', doing('fix'), {key: 'F', off: !one || !state.file.has_boxes,
                                           hint: 'merge a duplicate, or fit the landmark to its boxes'}),
              button('Delete', doing('discard'), {key: 'D', kind: 'danger', off: !one}),
              button('Skip', doing('step', {count: 1}), {key: 'N'})),
      one && one.decision ? el('p', {className: 'note done'}, one.decision) : null,
      one && one.is_checked ? (one.faults.length
        ? el('ul', {className: 'faults'}, ...one.faults.map(text => el('li', {}, text)))
        : el('p', {className: 'note done'}, 'no fault found')) : note(one && 'added after the check'),
      one?.support != null ? note(`detected in ${one.support} ${one.support === 1 ? 'frame' : 'frames'}`
        + (one.seen === null ? '' : `, in ${one.seen} of the ${one.expected} that should show it`)) : null,
      done === total ? buttons(button('Check again', doing('check'), {off: busy})) : null];
  },
  edit() {
    const {ids, one} = state.selection, boxes = state.file.has_boxes;
    const by = value => () => send('edit', {field: 'by', value, gesture: 'by'});
    if (!ids.length) return [note('Select a landmark in the list, the image or the scene. Hold Shift to select several.')];
    return [
      one ? el('div', {className: 'buttons nudge'}, ...['x', 'y', 'z'].flatMap((axis, place) =>
        [-1, 1].map(sign => button(`${axis}${sign < 0 ? '−' : '+'}`, by(axisStep(place, sign)),
                                   {off: one.is_locked, hint: 'move'}))),
        el('select', {title: 'Step size; arrow keys and page keys also move the landmark',
                      onchange: event => { step = Number(event.target.value); showPanel(); }},
           ...STEPS_M.map(value => el('option', {value, selected: value === step}, `${100 * value} cm`)))) : null,
      buttons(ids.length > 1 ? button('Merge', doing('merge'), {key: 'M', kind: 'main'})
                             : button('Refit to boxes', doing('refit'), {key: 'R', kind: 'main', off: !boxes, hint: 'fit it to the boxes of the recording'}),
              one ? button('Split', doing('split'), {hint: 'cut it in half along its longest axis'}) : null,
              button('Delete', doing('delete'), {key: 'Del', kind: 'danger'}))];
  },
  create() {
    const made = state.new;
    if (!made) return [note(`${capital(state.file.no_views)}.`)];
    const count = made.boxes.length, hasBox = made.boxes.some(([view]) => view === state.view.view);
    const value = name => typedNew[name] ?? (made.class_id && (name === 'class_id' ? made.class_id : `a ${made.class_id}`));
    const input = (name, text, list) => field(text, [value(name)], typed => { typedNew[name] = typed; showPanel(); }, {isText: true, list});
    return [
      note(['Draw a box around the object, or click a box of the detector.',
            'In another view, the object lies on the dashed line. Draw its box there.',
            'The dashed ellipse is the fit. A third box improves it.'][Math.min(count, 2)]),
      made.doubt ? el('p', {className: 'note', style: 'color:var(--bad)'}, made.doubt) : null,
      el('div', {className: 'chips'}, ...made.boxes.map(([view]) => button(
        viewName(view), doing('show_view', {view}), {hint: 'show it'}))),
      input('label', 'Label'), input('class_id', 'Class', 'classes'),
      buttons(button('Create', create, {key: '↵', kind: 'main', off: count < 2}),
              button('Next view', doing('next_view'), {key: 'C', off: !count, hint: 'a view from another side'}),
              button('Remove box', doing('forget', {view: state.view.view}), {key: 'Del', off: !hasBox}),
              button('Remove all boxes', doing('forget'), {off: !count}))];
  },
  test() {
    const test = state.test, is = name => test.running.includes(name), views = state.file.views,
      isAsked = is('relocalize_robot') || is('reload_robot');
    return [
      buttons(button('Relocalize the recording', doing('relocalize_all'), {kind: 'main', off: !views || is('relocalize_all')}),
              button('Relocalize here', doing('relocalize_here'), {off: !views}),
              is('check_map') ? button('Stop', doing('stop_check'), {kind: 'danger'})
                : button('Coverage and look-alikes', doing('check_map'), {hint: 'check the map, with simulated views all over it; takes a minute'}),
              test.has_page ? button('Open the check', () => window.open(`${base}check`)) : null),
      is('check_map') ? el('progress', {max: 1, value: test.share}) : null,
      test.is_stale ? note('The check is of the map before the last edits: check again.') : null,
      test.answers.length ? el('div', {className: 'answers'}, ...test.answers.map(([view, verdict, error, reason]) =>
        button(`${viewName(view)}: ${verdict}${error === null ? '' : `, off by ${error} m`}${reason ? `; ${reason}` : ''}`, doing('show_view', {view})))) : null,
      ...(test.robot ? [el('hr'), ...test.robot.map(note),
        buttons(button('Relocalize the robot', doing('relocalize_robot'), {off: isAsked}),
                button('Reload the map of the robot', doing('reload_robot'), {off: isAsked}),
                button('Show the robot', doing('look_at_robot')))] : [])];
  }};

function axisStep(place, sign) { return [0, 1, 2].map(axis => axis === place ? sign * step : 0); }

function create() {
  document.activeElement.blur?.();
  const made = state.new, [label, name] = ['label', 'class_id'].map(
    field => typedNew[field] ?? (made.class_id && (field === 'label' ? `a ${made.class_id}` : made.class_id)));
  send('create', {label, class_id: name});
  typedNew = {};
}

function showPanel() { fill($('panel'), PANELS[mode]()); }

function showRows() {
  const words = $('find').value.toLowerCase().split(/\s+/).filter(Boolean);
  const found = state.rows.filter(row => words.every(
    word => `${row[0]} ${row[1]} ${row[2]}`.toLowerCase().includes(word)));
  const chosen = new Set(state.selection.ids);
  const rows = found.slice(0, MOST_ROWS);
  for (const row of found.slice(MOST_ROWS)) if (chosen.has(row[0])) rows.push(row);
  const top = $('rows').scrollTop;
  fill($('rows'), rows.map(([id, label, name, isLocked, isHidden, severity, decision, color]) => {
    const side = (one, text, isOn, action) => el('button', {
      className: `icon${isOn ? ' on' : ''}`, title: text, 'aria-label': `${text} ${id}`.slice(0, 90),
      onclick: event => { event.stopPropagation(); send(action, {ids: [id]}); }}, icon(one));
    return el('div', {
      className: `row${severity >= 1 ? ' bad' : severity > 0 ? ' warn' : ''}${isHidden ? ' off' : ''}`,
      role: 'option', 'aria-selected': String(chosen.has(id)), title: `${id}\n${label}\n${name}`.slice(0, 400),
      onclick: event => send('select', {id, joins: event.shiftKey || event.ctrlKey})},
      el('b', {style: `background:${color}`}),
      el('span', {}, id.slice(0, 80), ' ', el('small', {}, label.slice(0, 80))),
      decision ? el('small', {className: 'done'}, {accepted: '✓', fixed: '✓ fixed'}[decision]) : null,
      side(isHidden ? 'unseen' : 'seen', isHidden ? 'Show' : 'Hide', isHidden, 'hide'),
      side(isLocked ? 'locked' : 'open', isLocked ? 'Unlock' : 'Lock', isLocked, 'lock'));
  }));
  if (found.length > MOST_ROWS) $('rows').append(note(`${found.length - MOST_ROWS} more landmarks: use Find`));
  $('rows').scrollTop = top;
  showChosen();
}

const showChosen = () => $('rows').querySelector('[aria-selected=true]')?.scrollIntoView({block: 'nearest'});

// ---- the image

function showView() {
  const view = state.view, svg = $('image');
  if (!view) return;
  const [width, height] = view.size;
  if (goal?.view === view.view) [zoom, goal] = [goal, null];
  else if (shownView !== view.view) zoom = null;
  shownView = view.view;
  applyZoom();
  if (document.activeElement !== $('slider')) $('slider').value = view.view;
  $('where').textContent = `${viewName(view.view)} of ${state.file.views}${view.camera ? `, camera ${view.camera}` : ''}`;
  $('empty').textContent = state.file.images ? '' : 'No images, only boxes: start the studio with --images to show images';
  const colors = Object.fromEntries(state.rows.map(row => [row[0], row[7]]));
  const chosen = new Set(state.selection.ids), scale = pixel();
  const ellipse = ([cx, cy, rx, ry, turn], name, color) => drawn('ellipse', {
    cx, cy, rx, ry, transform: `rotate(${turn} ${cx} ${cy})`, class: name,
    ...(color ? {style: `stroke:${color}`} : {})});
  let image = svg.querySelector('image');
  const href = `image/${person}/${view.view}`;
  if (image?.getAttribute('href') !== href || image.getAttribute('width') !== String(width)) {
    image = drawn('image', {href, width, height});
  }
  const shown = [image];
  for (const [left, top, right, bottom, name] of view.boxes) {
    const box = drawn('rect', {x: left, y: top, width: right - left, height: bottom - top, class: 'box'});
    box.append(Object.assign(drawn('title', {}), {textContent: name}));
    shown.push(box);
  }
  for (const [id, ...one] of [...view.outlines].reverse()) {
    shown.push(ellipse(one, `outline${chosen.has(id) ? ' chosen' : ''}`, chosen.has(id) ? '' : colors[id]));
    if (chosen.has(id)) {
      const text = drawn('text', {x: one[0], y: one[1] - Math.max(one[2], one[3]) - 5 * scale, 'text-anchor': 'middle', style: `font-size:${13 * scale}px`});
      text.textContent = id.slice(0, 60);
      shown.push(text);
    }
  }
  if (mode === 'create' && state.new) {
    if (view.guide.length) shown.push(drawn('polyline', {points: view.guide.map(one => one.join(',')).join(' '), class: 'guess'}));
    for (const one of view.guess) shown.push(ellipse(one, 'guess'));
    const box = drag?.box || mine();
    if (box) {
      const [left, top, right, bottom] = box;
      shown.push(drawn('rect', {x: left, y: top, width: right - left, height: bottom - top, class: 'mine'}));
      for (const x of [left, (left + right) / 2, right]) {
        for (const y of [top, (top + bottom) / 2, bottom]) {
          if (x !== (left + right) / 2 || y !== (top + bottom) / 2) shown.push(drawn('circle', {cx: x, cy: y, r: 4 * scale, class: 'grip'}));
        }
      }
    }
  }
  svg.replaceChildren(...shown);
}

const mine = () => state.new?.boxes.find(([view]) => view === state.view.view)?.[1];

function applyZoom() {
  const [width, height] = state.view.size;
  const one = zoom || {x: 0, y: 0, w: width, h: height};
  $('image').setAttribute('viewBox', `${one.x} ${one.y} ${one.w} ${one.h}`);
}

// Number of image pixels per screen pixel.
function pixel() {
  const matrix = $('image').getScreenCTM();
  return matrix ? 1 / matrix.a : 1;
}

function place(event) {
  const point = new DOMPoint(event.clientX, event.clientY).matrixTransform($('image').getScreenCTM().inverse());
  return [point.x, point.y];
}

function zoomBy(factor, [x, y]) {
  const [width, height] = state.view.size, box = $('image').viewBox.baseVal;
  const w = Math.max(20, box.width * factor), h = box.height * w / box.width;
  zoom = w >= 1.1 * width && h >= height ? null : {
    x: x - (x - box.x) * w / box.width, y: y - (y - box.y) * h / box.height, w, h};
  applyZoom();
  showView();
}

function pointerDown(event) {
  if (!state.view) return;
  const [x, y] = place(event), near = 8 * pixel(), box = mine();
  $('image').setPointerCapture(event.pointerId);
  drag = {start: [x, y], at: [event.clientX, event.clientY], isMoved: false, kind: 'pan'};
  if (mode !== 'create' || event.button !== 0) return;
  drag.kind = 'draw';
  const isIn = box && x > box[0] - near && x < box[2] + near && y > box[1] - near && y < box[3] + near;
  if (isIn) {
    const edges = [0, 1, 2, 3].map(edge => Math.abs((edge % 2 ? y : x) - box[edge]) < near);
    Object.assign(drag, {kind: 'change', from: box, edges: edges.some(Boolean) ? edges : [true, true, true, true]});
  }
}

function pointerMove(event) {
  if (!drag) return;
  drag.isMoved ||= Math.hypot(event.clientX - drag.at[0], event.clientY - drag.at[1]) > 3;
  if (!drag.isMoved) return;
  const [x, y] = place(event), [fromX, fromY] = drag.start;
  if (drag.kind === 'pan') {
    const box = $('image').viewBox.baseVal;
    zoom = {x: box.x + fromX - x, y: box.y + fromY - y, w: box.width, h: box.height};
    $('image').setAttribute('viewBox', `${zoom.x} ${zoom.y} ${zoom.w} ${zoom.h}`);
    return;
  }
  const box = drag.kind === 'draw' ? [fromX, fromY, x, y]
    : drag.from.map((value, edge) => drag.edges[edge] ? value + (edge % 2 ? y - fromY : x - fromX) : value);
  drag.box = [Math.min(box[0], box[2]), Math.min(box[1], box[3]), Math.max(box[0], box[2]), Math.max(box[1], box[3])];
  showView();
}

function pointerUp(event) {
  const done = drag;
  drag = null;
  if (!done) return;
  if (done.box) {
    send('draw', {view: state.view.view, corner: done.box.slice(0, 2), other: done.box.slice(2)});
    const own = state.new.boxes.find(([view]) => view === state.view.view);
    if (own) own[1] = done.box; else state.new.boxes.push([state.view.view, done.box]);
    showView();
  } else if (!done.isMoved) {
    const [x, y] = done.start;
    const box = smallest(state.view.boxes.filter(one => x > one[0] && x < one[2] && y > one[1] && y < one[3]),
                         one => (one[2] - one[0]) * (one[3] - one[1]));
    if (mode === 'create' && box && event.button === 0) {
      send('draw', {view: state.view.view, corner: box.slice(0, 2), other: box.slice(2, 4)});
    } else {
      const outline = smallest(state.view.outlines.filter(one => isAround(one, x, y)), one => one[3] * one[4]);
      send('select', {id: outline ? outline[0] : ''});
    }
  }
}

const smallest = (found, size) => found.sort((one, other) => size(one) - size(other))[0];

// Whether a point is inside an outline (id, centre, semi-axes, angle).
function isAround([, cx, cy, rx, ry, turn], x, y) {
  const angle = turn * Math.PI / 180, dx = x - cx, dy = y - cy;
  return Math.hypot((dx * Math.cos(angle) + dy * Math.sin(angle)) / rx,
                    (dy * Math.cos(angle) - dx * Math.sin(angle)) / ry) < 1;
}

function stepView(count) {
  if (!state.view) return;
  send('show_view', {view: Math.max(0, Math.min(state.file.views - 1, state.view.view + count))});
}

function bestView() {
  const seen = state.selection.one?.sightings;
  if (!seen?.length) return;
  const now = seen.findIndex(one => one[0] === state.view.view);
  lookAt(seen[(now + 1) % seen.length]);
}

function showStrip() {
  const seen = state.selection.one?.sightings || [];
  const isWanted = state.file.images && mode !== 'create' && mode !== 'test';
  fill($('strip'), !isWanted ? [] : seen.map(one => el('button', {
    className: one[0] === state.view?.view ? 'now' : '', title: `${viewName(one[0])}${one[5] ? '' : ', not detected'}`,
    onclick: () => lookAt(one)},
    el('img', {src: `crop/${person}/${one[0]}/${one.slice(1, 5).join(',')}`, alt: ''}),
    el('small', {}, `${one[0] + 1}${one[5] ? '' : ' ?'}`))));
}

// ---- the panel of the scene: layers, viewpoints, the recording as a film

const box = (text, isOn, apply) => el('label', {}, el('input', {
  type: 'checkbox', checked: isOn, onchange: event => apply(event.target.checked)}), ` ${text}`);
const layerBox = name => box(name, state.layers[name], is_shown => send('show_layer', {name, is_shown}));

function showLayers() {
  fill($('layers'), [
    buttons(button('Whole map', doing('overview'), {key: 'O'}),
            button('From above', doing('from_above'), {key: 'B'}),
            button('Selection', doing('look_at_landmark'), {key: 'G'})),
    ...Object.keys(state.layers).map(layerBox),
    ...(state.file.views ? [box('Follow the view', follows, followView),
                            button(film ? 'Stop' : 'Play the recording', playOrStop)] : [])]);
}

// Hides the cameras, which would cover the view.
function followView(isOn) {
  follows = isOn;
  send('show_layer', {name: 'Cameras', is_shown: !isOn});
  if (isOn) send('look_through');
}

function playOrStop() {
  if (film) { clearInterval(film); film = null; } else {
    film = setInterval(() => {
      if (state.view.view >= state.file.views - 1) playOrStop(); else stepView(Math.max(1, Math.round(state.file.views / MOST_PICTURES)));
    }, PICTURE_MS);
  }
  showLayers();
}

function showLog() {
  const lines = [...state.log.lines].reverse(), isOld = lines.length && state.log.is_old;
  fill($('log'), (lines.length ? lines : [['', 'Ready. Press ? for keyboard shortcuts.']]).map(([kind, text], row) => el(
    'div', {className: row ? `${kind} old` : isOld ? 'past' : kind, title: text}, row || !isOld ? text : `earlier: ${text}`)));
  $('log').scrollTop = 0;
}

// ---- keys

const KEYS = {
  all: {'ctrl+z': ['undo', doing('undo')], 'ctrl+y': ['redo', doing('redo')], 'ctrl+s': ['save', doing('save')],
        ',': ['previous view', () => stepView(-1)], '.': ['next view', () => stepView(1)],
        v: ['best view of the landmark, then the next best', bestView], t: ['move the scene\'s camera to the view', doing('look_through')],
        g: ['look at the landmark', doing('look_at_landmark')], o: ['show the whole map', doing('overview')],
        b: ['show the map from above', doing('from_above')], l: ['lock, unlock', () => send('lock')],
        h: ['hide, show', () => send('hide', {ids: state.selection.ids})], 0: ['whole image', () => { zoom = null; showView(); }],
        '/': ['find', () => $('find').focus()], '?': ['keyboard shortcuts', () => showKeys()], n: ['next landmark', doing('step', {count: 1})],
        p: ['previous landmark', doing('step', {count: -1})],
        ...Object.fromEntries(MODES.map((name, row) => [row + 1, [name, () => setMode(name)]]))},
  review: {a: ['accept, select the next', doing('accept')], f: ['fix: merge a duplicate, or fit to boxes', doing('fix')],
           d: ['delete, select the next', doing('discard')], delete: ['delete, select the next', doing('discard')],
           e: ['type a label', () => focusLabel()], arrowleft: ['previous view', () => stepView(-1)], arrowright: ['next view', () => stepView(1)]},
  edit: {delete: ['delete', doing('delete')], r: ['refit to boxes', doing('refit')], m: ['merge', doing('merge')],
         e: ['type a label', () => focusLabel()],
         ...Object.fromEntries(['arrowleft', 'arrowright', 'arrowdown', 'arrowup', 'pagedown', 'pageup'].map((key, row) => [
           key, [`move along ${'xyz'[row >> 1]}`, () => send('edit', {field: 'by', value: axisStep(row >> 1, row % 2 ? 1 : -1), gesture: 'by'})]]))},
  create: {enter: ['create', () => create()], c: ['next view for a box', doing('next_view')],
           delete: ['remove the box of this view', () => send('forget', {view: state.view?.view})],
           arrowleft: ['previous view', () => stepView(-1)], arrowright: ['next view', () => stepView(1)]},
  test: {arrowleft: ['previous view', () => stepView(-1)], arrowright: ['next view', () => stepView(1)]}};

function focusLabel() {
  const input = $('card').querySelector('input');
  input?.focus();
  input?.select();
}

const SIGNS = {arrowleft: '←', arrowright: '→', arrowup: '↑', arrowdown: '↓', pageup: 'Page ↑', pagedown: 'Page ↓'};

function showKeys() {
  const table = keys => el('table', {}, ...Object.entries(keys).map(([key, [text]]) => el(
    'tr', {}, el('td', {}, el('kbd', {}, SIGNS[key] || key.split('+').map(capital).join('+'))), el('td', {}, capital(text)))));
  fill($('keys'), [el('b', {}, capital(mode)), table(KEYS[mode]), el('b', {}, 'In all modes'), table(KEYS.all)]);
  $('keys').showModal();
}

function keyDown(event) {
  const isTyping = event.target.matches?.('input:not([type=range]):not([type=checkbox]), select, textarea');
  if (event.key === 'Escape') { event.target.blur?.(); return; }
  if ($('keys').open || event.altKey) return;
  const isControl = event.ctrlKey || event.metaKey;
  if (isTyping && !(isControl && event.key.toLowerCase() === 's')) return;
  const key = (isControl ? 'ctrl+' : '') + event.key.toLowerCase();
  const found = KEYS[mode][key] || KEYS.all[key === 'ctrl+z' && event.shiftKey ? 'ctrl+y' : key];
  if (!found || (event.target.tagName === 'BUTTON' && key === 'enter')) return;
  event.preventDefault();
  event.stopImmediatePropagation();
  if (isTyping) event.target.blur();
  found[1]();
}

// ---- start

for (const one of document.querySelectorAll('[data-icon]')) {
  one.append(icon(one.dataset.icon));
  one.setAttribute('aria-label', one.title);
}
for (const one of document.querySelectorAll('[data-do]')) {
  one.addEventListener('click', () => { send(one.dataset.do); $('menu').open = false; });
}
$('show_all').onclick = () => {
  const hidden = state.rows.filter(row => row[4]).map(row => row[0]);
  if (hidden.length) send('hide', {ids: hidden});
  $('menu').open = false;
};
$('help').onclick = () => { $('menu').open = false; showKeys(); };
$('keys').onclick = () => $('keys').close();
$('find').oninput = showRows;
$('before').onclick = () => stepView(-1);
$('after').onclick = () => stepView(1);
$('slider').oninput = event => send('show_view', {view: Number(event.target.value)});
$('slider').onchange = event => event.target.blur();
$('best').onclick = bestView;
$('whole').onclick = () => { zoom = null; showView(); };
$('log').onclick = () => $('log').classList.toggle('tall');
$('image').onpointerdown = pointerDown;
$('image').onpointermove = pointerMove;
$('image').onpointerup = pointerUp;
$('image').oncontextmenu = event => event.preventDefault();
$('image').addEventListener('wheel', event => { event.preventDefault(); if (state.view) zoomBy(Math.exp(event.deltaY * 0.0015), place(event)); }, {passive: false});
$('splitter').onpointerdown = event => { event.target.setPointerCapture(event.pointerId); document.body.classList.add('dragging'); };
$('splitter').onpointermove = event => {
  if (!document.body.classList.contains('dragging')) return;
  const left = $('view').getBoundingClientRect().left, width = window.innerWidth - left;
  shares[mode] = Math.max(0.15, Math.min(0.85, (event.clientX - left) / width));
  resize();
};
$('splitter').onpointerup = () => { document.body.classList.remove('dragging'); if (state.view) showView(); };
document.addEventListener('click', event => { if (!$('menu').contains(event.target)) $('menu').open = false; });
window.addEventListener('resize', () => { resize(); showView(); });
new ResizeObserver(showChosen).observe($('rows'));
window.addEventListener('keydown', keyDown, true);
// The keys also work in the scene, where they take precedence over viser's keys.
$('frame').onload = () => {
  const scene = $('frame').contentWindow;
  scene.addEventListener('keydown', keyDown, true);
  scene.document.head.append(el('link', {rel: 'stylesheet', href: `${base}scene.css`}));
};
$('frame').src = `${base}scene/${person}/`;
setMode('review');
connect();

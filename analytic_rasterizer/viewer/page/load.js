// Brings the scene into the page: from the server, or from the elements of an exported file.

import { decompress } from './compressed.js';

const embedded = name => document.getElementById(`data-${name}`);

/// Whether page and scene are one file.
export const isExported = () => embedded('scene') !== null;

/// What there is to know of the scene before it is loaded: `meta` of viewer/packing.py.
export async function loadMeta() {
  return isExported() ? JSON.parse(embedded('scene').textContent) : (await get('scene.json')).json();
}

/// {meta, geometry, harmonics}; `progress` is called with the part that has been read, from 0 to 1.
export async function loadScene(meta, progress) {
  if (isExported()) {
    const first = await unpack(meta.compressed ? 'columns' : 'geometry');
    progress(0.5);
    await new Promise(resolve => setTimeout(resolve));  // or it would not be seen: to decompress may take seconds
    return meta.compressed ? { meta, ...decompress(meta, first) } : sceneOf(meta, first, await unpack('harmonics'));
  }
  const responses = await Promise.all([get('geometry.bin'), get('harmonics.bin')]);
  const total = sizeOf(responses[0]) + sizeOf(responses[1]);
  let done = 0;
  const note = bytes => progress((done += bytes) / total);
  return sceneOf(meta, ...await Promise.all(responses.map(response => readAll(response, note))));
}

/// For compact scenes also `packed`, as it came; `geometry` then has no quaternions.
function sceneOf(meta, geometry, harmonics) {
  if (!meta.compact) return { meta, geometry: new Float32Array(geometry), harmonics: new Uint16Array(harmonics) };
  const packed = new Uint32Array(geometry), floats = new Float32Array(geometry), halves = new Uint16Array(geometry);
  const made = new Float32Array(2 * floats.length);
  const half = bits => (bits < 1024 ? bits / 1024 : (1 + (bits & 1023) / 1024) * 2 ** ((bits >> 10) - 1)) / 16384;
  for (let at = 0; at < floats.length; at += 6) {
    made.set(floats.subarray(at, at + 3), 2 * at);
    made[2 * at + 3] = half(halves[2 * at + 9]);
    for (let k = 0; k < 3; ++k) made[2 * at + 4 + k] = meta.compact * half(halves[2 * at + 6 + k]);
  }
  return { meta, geometry: made, packed, harmonics: new Uint32Array(harmonics) };
}

/// The worker that sorts; sort.js of the server, or the text of it in an exported file.
export function startSorter() {
  if (!isExported()) return new Worker('sort.js');
  const url = URL.createObjectURL(new Blob([embedded('sorter').textContent], { type: 'text/javascript' }));
  return new Worker(url);
}

/// What the server answers. Throws an Error with `sentence`, and what the server says.
export async function get(name, sentence = 'The scene cannot be loaded.') {
  const response = await fetch(name).catch(() => null);
  if (!response) throw new Error(`${sentence} Is the command that serves it still running?`);
  if (!response.ok) throw new Error(`${sentence} ${await response.text()}`);
  return response;
}

const sizeOf = response => Number(response.headers.get('Content-Length'));

/// `note` is called with the bytes of every part.
async function readAll(response, note) {
  const bytes = new Uint8Array(sizeOf(response)), reader = response.body.getReader();
  let length = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    bytes.set(value, length);
    length += value.length;
    note(value.length);
  }
  if (length !== bytes.length) throw new Error('The connection ended before the scene was complete.');
  return bytes.buffer;
}

async function unpack(name) {
  const element = embedded(name), text = atob(element.textContent);
  element.remove();
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; ++i) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('gzip'));
  return new Response(stream).arrayBuffer();
}

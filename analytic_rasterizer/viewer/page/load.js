// Brings the scene into the page: from the server, or from the elements of an exported file.

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
    const geometry = await unpack('geometry');
    progress(0.5);
    const harmonics = await unpack('harmonics');
    return { meta, geometry: new Float32Array(geometry), harmonics: new Uint16Array(harmonics) };
  }
  const responses = await Promise.all([get('geometry.bin'), get('harmonics.bin')]);
  const sizes = responses.map(response => Number(response.headers.get('Content-Length')));
  const done = [0, 0], total = sizes[0] + sizes[1];
  const buffers = await Promise.all(responses.map((response, i) =>
    readAll(response, sizes[i], bytes => {
      done[i] = bytes;
      progress((done[0] + done[1]) / total);
    })));
  return { meta, geometry: new Float32Array(buffers[0]), harmonics: new Uint16Array(buffers[1]) };
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

async function readAll(response, size, progress) {
  const bytes = new Uint8Array(size), reader = response.body.getReader();
  let length = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    bytes.set(value, length);
    length += value.length;
    progress(length);
  }
  if (length !== size) throw new Error('The connection ended before the scene was complete.');
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

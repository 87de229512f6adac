// A scene file that is dropped on the page is given to the command that serves it, which then serves this scene.

import { READING_TIME, announce, hideProgress, showProgress } from './interface.js';
import { isExported } from './load.js';

async function openFile(file) {
  if (isExported()) throw new Error('This page holds one scene. python -m analytic_rasterizer view FILE opens another.');
  showProgress(`Opening ${file.name}`);
  const response = await fetch(`open?name=${encodeURIComponent(file.name)}`, { method: 'POST', body: file })
    .catch(() => null);
  if (!response) throw new Error(`${file.name} cannot be opened. Is the command that serves this page still running?`);
  if (!response.ok) throw new Error(await response.text());
  history.replaceState(null, '', location.pathname + location.search);  // what it says is of the scene before
  location.reload();
}

/// Opens what is dropped on the page.
export function acceptFiles() {
  const { classList } = document.body;
  window.addEventListener('dragover', event => {
    event.preventDefault();  // or the browser would leave the page
    classList.add('dropping');
  });
  window.addEventListener('dragleave', event => { if (event.relatedTarget === null) classList.remove('dropping'); });
  window.addEventListener('drop', event => {
    event.preventDefault();
    classList.remove('dropping');
    const [file] = event.dataTransfer.files;
    if (!file) return;
    openFile(file).catch(error => {
      hideProgress();
      announce(error.message.trim(), 3 * READING_TIME);
    });
  });
}

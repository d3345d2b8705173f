// The list of bakes, asked for again every other second. Text only ever enters through textContent.
const body = document.getElementById("jobs");
const note = document.getElementById("note");

function cell(row, content) {
  const td = row.insertCell();
  if (content instanceof Node) td.append(content);
  else td.textContent = content;
}

function link(href, text) {
  const a = document.createElement("a");
  a.href = href;
  a.textContent = text;
  return a;
}

function row(bake) {
  const tr = document.createElement("tr");
  const bar = document.createElement("progress");
  bar.value = bake.state === "succeeded" ? 1 : bake.progress?.fraction ?? 0;
  const error = bake.progress?.error;
  cell(tr, link(`/web/bakes/${bake.id}`, bake.id));
  cell(tr, bake.error ? `${bake.state}: ${bake.error.slug}` : bake.state);
  cell(tr, bar);
  cell(tr, bake.progress?.samples ?? "");
  cell(tr, error == null ? "" : `${(error * 100).toPrecision(2)} %`);
  cell(tr, new Date(bake.created).toLocaleString());
  cell(tr, bake.links.bundle ? link(bake.links.bundle, "bundle") : "");
  return tr;
}

async function refresh() {
  try {
    const answer = await fetch("/v1/bakes?limit=50");
    if (answer.status === 401) {
      note.textContent = "";
      askForToken();
      return;
    }
    if (!answer.ok) throw new Error(`the service answered ${answer.status}`);
    const { items } = await answer.json();
    body.replaceChildren(...items.map(row));
    note.textContent = items.length ? "" : "No bakes yet.";
  } catch (error) {
    note.textContent = `Cannot reach the service: ${error.message}`;
  }
  setTimeout(refresh, 2000);
}

refresh();

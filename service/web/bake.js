// One bake as it goes: its state, and each point of its curve as a pass ends. Everything the service says goes in through textContent.
const id = decodeURIComponent(location.pathname.split("/").pop());
const path = `/v1/bakes/${encodeURIComponent(id)}`;
const FINISHED = ["succeeded", "failed", "cancelled", "expired"];
const place = (name) => document.getElementById(name);
place("id").textContent = id;

function percent(error) {
  return error == null ? "unknown" : `${(error * 100).toPrecision(2)} %`;
}

function addPoint(point) {
  const row = place("points").insertRow();
  for (const text of [point.samples, point.rays.toLocaleString(), point.seconds.toFixed(1), percent(point.error)]) {
    row.insertCell().textContent = text;
  }
  // The number makes it another address, so that the picture is asked for anew.
  place("curve").src = `/web/bakes/${encodeURIComponent(id)}/curve.svg?samples=${point.samples}`;
  place("curve").hidden = false;
}

async function finish(state) {
  place("bar").hidden = true;
  const bake = await (await fetch(path)).json();
  place("state").textContent = bake.error ? `${state}: [${bake.error.slug}] ${bake.error.message}` : state;
  for (const name of ["bundle", "report"].filter((name) => name in bake.links)) {
    const a = document.createElement("a");
    a.href = bake.links[name];
    a.textContent = name;
    place("links").append(a, " ");
  }
}

const events = new EventSource(`${path}/events`);
const on = (type, act) => events.addEventListener(type, (event) => act(JSON.parse(event.data)));
on("pass", addPoint);
on("progress", (told) => {
  place("bar").value = told.fraction;
  place("state").textContent = told.stage;
});
on("state", ({ state }) => {
  place("state").textContent = state;
  if (!FINISHED.includes(state)) return;
  // The service closes the stream now, and a browser would open it again.
  events.close();
  finish(state);
});
events.onerror = () => {
  if (events.readyState === EventSource.CLOSED) place("state").textContent = `There is no bake ${id}, or the service cannot be reached.`;
};

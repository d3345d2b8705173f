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
  place("preview").src = `${path}/preview?samples=${point.samples}`;
  place("preview").hidden = false;
}

function duration(seconds) {
  return seconds < 100 ? `${seconds.toFixed(0)} s` : `${(seconds / 60).toFixed(0)} min`;
}

// What the stream does not tell: how long it may take, what belongs to it, how often it was tried.
async function look() {
  const bake = await (await fetch(path)).json();
  const range = bake.progress?.eta_range;
  place("eta").textContent = range && !FINISHED.includes(bake.state) ? `${duration(range[0])} to ${duration(range[1])} to go` : "";
  place("links").replaceChildren();
  for (const name of Object.keys(bake.links).filter((name) => name !== "self" && name !== "events")) {
    const a = document.createElement("a");
    a.href = bake.links[name];
    a.textContent = name;
    place("links").append(a, " ");
  }
  place("attempts").textContent = bake.attempts ? `${bake.attempts} workers were lost on the way; see the log.` : "";
  return bake;
}

async function finish(state) {
  place("bar").hidden = true;
  const bake = await look();
  place("state").textContent = bake.error ? `${state}: [${bake.error.slug}] ${bake.error.message}` : state;
}

const events = new EventSource(`${path}/events`);
const on = (type, act) => events.addEventListener(type, (event) => act(JSON.parse(event.data)));
on("pass", (point) => {
  addPoint(point);
  look();
});
on("plan", look);
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
events.onerror = async () => {
  if (events.readyState !== EventSource.CLOSED) return;
  // An EventSource does not say why.
  const answer = await fetch(path).catch(() => null);
  if (answer?.status === 401) askForToken();
  place("state").textContent = answer == null ? "The service cannot be reached." : answer.ok ? "" : (await answer.json()).detail;
};

// The form for a token, shown where the service asks for one. The service keeps it in a cookie that scripts cannot read.
const form = document.getElementById("token");

function askForToken() {
  form.hidden = false;
}

form.addEventListener("submit", async (event) => {
  event.preventDefault();
  const body = JSON.stringify({ token: form.elements.secret.value });
  const answer = await fetch("/web/session", { method: "POST", headers: { "Content-Type": "application/json" }, body });
  if (answer.ok) location.reload();
  else document.getElementById("refused").textContent = (await answer.json()).detail;
});

// Sends a file that is dropped or chosen to the viewer, and then shows its scene.

const zone = document.getElementById("drop"), chosen = document.getElementById("file"), said = document.getElementById("said");

function say(text) {
  said.textContent = text;
  said.hidden = !text;
}

async function send(file) {
  chosen.disabled = true;
  say(`Opening ${file.name} …`);
  try {
    const answer = await fetch(`/drop?name=${encodeURIComponent(file.name)}`, { method: "POST", body: file });
    if (answer.ok) return location.assign("/");
    say((await answer.text()) || `${file.name} was refused (${answer.status}).`);
  } catch {
    say("The viewer does not answer, or takes no file of this size.");
  }
  chosen.disabled = false;
  chosen.value = "";
}

chosen.addEventListener("change", () => chosen.files.length && send(chosen.files[0]));
for (const name of ["dragenter", "dragover", "dragleave", "drop"]) {
  document.addEventListener(name, (event) => {
    event.preventDefault(); // the browser would leave the page for the file
    zone.classList.toggle("over", name === "dragenter" || name === "dragover");
    if (name === "drop" && event.dataTransfer.files.length && !chosen.disabled) send(event.dataTransfer.files[0]);
  });
}

// Sends a file that is dropped or chosen to the viewer, and then shows its scene.

const zone = document.getElementById("drop"), chosen = document.getElementById("file"), said = document.getElementById("said");

function say(text) {
  said.textContent = text;
  said.hidden = !text;
}

function send(file) {
  const request = new XMLHttpRequest(); // fetch does not say how much has been sent
  request.open("POST", `/drop?name=${encodeURIComponent(file.name)}`);
  request.upload.addEventListener("progress", ({ loaded, total }) => {
    say(loaded < total ? `Reading ${file.name}, ${Math.round((100 * loaded) / total)} %` : `Opening ${file.name} …`);
  });
  request.addEventListener("load", () => {
    if (request.status === 204) location.assign("/");
    else done(request.responseText || `${file.name} was refused (${request.status}).`);
  });
  request.addEventListener("error", () => done("The viewer does not answer, or takes no file of this size."));
  chosen.disabled = true;
  say(`Reading ${file.name}`);
  request.send(file);
}

function done(text) {
  chosen.disabled = false;
  chosen.value = "";
  say(text);
}

chosen.addEventListener("change", () => chosen.files.length && send(chosen.files[0]));
for (const name of ["dragenter", "dragover", "dragleave", "drop"]) {
  document.addEventListener(name, (event) => {
    event.preventDefault(); // the browser would leave the page for the file
    zone.classList.toggle("over", name === "dragenter" || name === "dragover");
    if (name === "drop" && event.dataTransfer.files.length && !chosen.disabled) send(event.dataTransfer.files[0]);
  });
}

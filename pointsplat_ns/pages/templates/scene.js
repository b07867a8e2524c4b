const data = JSON.parse(document.getElementById("data").textContent);
const flight = new Flight(document.getElementById("flight"), data.flight);
document.querySelector("canvas").focus({ preventScroll: true });

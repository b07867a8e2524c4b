const data = JSON.parse(document.getElementById("data").textContent);
const flight = new (data.flight.kept ? Live : Flight)(document.getElementById("flight"), data.flight);
document.querySelector("canvas").focus({ preventScroll: true });

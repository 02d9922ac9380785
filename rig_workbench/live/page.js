// STOP and PAUSE are plain requests, so that they work while the page reconnects.
"use strict";

const live = {
  head(html, running) {
    document.getElementById("head").innerHTML = html;
    document.getElementById("actions").hidden = !running;
    document.title = document.querySelector("#head .now").textContent + " · jaxcal";
  },

  async ask(what, clicked) {
    const answer = document.getElementById("answer");
    const late = document.getElementById("late");
    const show = (look, text) => {
      answer.className = look;
      answer.textContent = text;
    };
    show("", "Asking the session to " + what + " …");
    /* Due a second after the click on the browser's own clock. The compositor shows it:
       neither the server nor a scene that keeps this thread busy can hold it up. */
    const silence = late.animate([{ opacity: 0 }, { opacity: 1 }], {
      delay: 1000, duration: 1, fill: "both",
    });
    silence.startTime = clicked;
    silence.onfinish = () => show("bad", late.textContent); /* for screen readers */
    try {
      const reply = await fetch("/" + what, { method: "POST" });
      show(reply.ok ? "good" : "bad", await reply.text());
    } catch {
      show(
        "bad",
        "NOT SENT: the page has lost its server. Press Ctrl-C twice in the terminal, " +
          "run jaxcal-rig stop, or use the emergency stop.",
      );
    } finally {
      silence.cancel();
    }
  },
};

for (const what of ["pause", "stop"])
  document.getElementById(what).addEventListener("click", (click) =>
    live.ask(what, click.timeStamp),
  );

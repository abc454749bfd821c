"""A browser without a window, spoken to in Chrome's protocol over a pair of pipes."""

import json
import os
import subprocess
import tempfile

QUIET = [
    *(
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
    ),
    *(
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
    ),
    *("--allow-file-access-from-files", "--hide-scrollbars", "--remote-debugging-pipe"),
]


class Chromium:
    """One tab; `with Chromium(path) as tab: tab.open(url)`."""

    def __init__(self, program):
        """The program is started when the block is entered."""
        self.program, self.sent, self.events, self.session = program, 0, [], None

    def __enter__(self):
        self.profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        (commands, ours), (theirs, answers) = os.pipe(), os.pipe()
        # The browser reads commands from descriptor 3 and answers on 4.
        line = f'exec "$@" 3<&{commands} 4>&{answers}'
        arguments = [self.program, *QUIET, f"--user-data-dir={self.profile.name}"]
        self.process = subprocess.Popen(
            ["bash", "-c", line, "bash", *arguments],
            pass_fds=(commands, answers),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(commands)
        os.close(answers)
        self.to, self.back, self.heard = ours, theirs, b""
        target = self("Target.createTarget", url="about:blank")["targetId"]
        found = self("Target.attachToTarget", targetId=target, flatten=True)
        self.session = found["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self(f"{domain}.enable")
        return self

    def __exit__(self, *_):
        self.session = None
        self("Browser.close")
        self.process.wait(30)
        os.close(self.to)
        os.close(self.back)
        self.profile.cleanup()

    def __call__(self, method, **params):
        """One command, and its answer; what happens until then is kept in `events`."""
        self.sent += 1
        command = {"id": self.sent, "method": method, "params": params}
        if self.session:
            command["sessionId"] = self.session
        os.write(self.to, json.dumps(command).encode() + b"\0")
        answer = self.read(lambda x: x.get("id") == self.sent)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return answer["result"]

    def read(self, wanted):
        """The next message that is wanted."""
        while True:
            while b"\0" not in self.heard:
                if not (more := os.read(self.back, 1 << 16)):
                    raise RuntimeError("the browser ended")
                self.heard += more
            text, self.heard = self.heard.split(b"\0", 1)
            message = json.loads(text)
            self.events.append(message)
            if wanted(message):
                return message

    def open(self, url, width=1280, height=900):
        """Load a page in a window of this size."""
        size = {
            "width": width,
            "height": height,
            "deviceScaleFactor": 1,
            "mobile": False,
        }
        self("Emulation.setDeviceMetricsOverride", **size)
        self.events.clear()
        self("Page.navigate", url=url)
        if not any(x.get("method") == "Page.loadEventFired" for x in self.events):
            self.read(lambda x: x.get("method") == "Page.loadEventFired")

    def evaluate(self, script):
        """The value of an expression of JavaScript, a promise awaited."""
        answer = self(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in answer:
            raise RuntimeError(answer["exceptionDetails"])
        return answer["result"].get("value")

    def complaints(self):
        """Errors of scripts and of loading since the page was opened."""
        said = []
        for event in self.events:
            params = event.get("params", {})
            match event.get("method"):
                case "Runtime.exceptionThrown":
                    details = params["exceptionDetails"]
                    said.append(
                        details.get("exception", details).get(
                            "description", str(details)
                        )
                    )
                case "Log.entryAdded" if params["entry"]["level"] == "error":
                    said.append(
                        f"{params['entry']['text']} {params['entry'].get('url', '')}"
                    )
                case "Runtime.consoleAPICalled" if params["type"] == "error":
                    said.append(str(params["args"]))
                case "Network.requestWillBeSent":
                    address = params["request"]["url"]
                    if not address.startswith(("file:", "data:", "blob:", "about:")):
                        said.append(f"asks the network for {address}")
        return said

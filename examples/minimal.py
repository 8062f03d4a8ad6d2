"""Follow a target with the exported graphs alone: onnxruntime, numpy and OpenCV, the plain procedure.

    python minimal.py GRAPHS VIDEO x,y,w,h

GRAPHS is a folder that `psiamfcpp export` wrote; a box x,y,w,h a line is printed for each frame.
"""

import json
import math
import sys

import cv2
import numpy as np
import onnxruntime


def context_side(w, h):
    p = (w + h) / 2
    return math.sqrt((w + p) * (h + p))


def crop(frame, cx, cy, side, size, fill):
    scale, half = (side - 1) / (size - 1), (side - 1) / 2
    to_frame = np.array([[scale, 0, cx - half], [0, scale, cy - half]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(frame, to_frame, (size, size), flags=flags, borderValue=fill)


def change(ratio):
    return np.maximum(ratio, 1 / ratio)


class Minimal:
    def __init__(self, folder, threads=0):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads  # 0: all cores
        # without this, sums of 8-bit products saturate on x86 processors that lack VNNI
        options.add_session_config_entry("session.x64quantprecision", "1")
        self.template = onnxruntime.InferenceSession(f"{folder}/template.onnx", options)
        self.search = onnxruntime.InferenceSession(f"{folder}/search.onnx", options)
        self.spec = json.loads(self.search.get_modelmeta().custom_metadata_map["spec"])

    def init(self, frame, box):
        x, y, self.w, self.h = box
        self.cx, self.cy = x + (self.w - 1) / 2, y + (self.h - 1) / 2
        self.smallest = min(10, self.w, self.h)
        self.fill = cv2.mean(frame)[:3]
        z = crop(frame, self.cx, self.cy, round(context_side(self.w, self.h)), self.spec["template_size"], self.fill)
        cls, reg = self.template.run(None, {"crop": z[None]})
        self.kernels = {"cls_kernel": cls, "reg_kernel": reg}

    def update(self, frame):
        small, size, constants = self.spec["template_size"], self.spec["search_size"], self.spec["constants"]
        scale = small / context_side(self.w, self.h)
        x = crop(frame, self.cx, self.cy, round(context_side(self.w, self.h) * size / small), size, self.fill)
        scores, boxes = (out[0] for out in self.search.run(None, {"crop": x[None], **self.kernels}))
        w, h = (np.maximum(boxes[..., i + 2] - boxes[..., i] + 1, 1e-3) for i in (0, 1))
        pad = (w + h) / 2
        size_change = change(np.sqrt((w + pad) * (h + pad)) / small)
        penalty = np.exp(-(change((self.w / self.h) / (w / h)) * size_change - 1) * constants["penalty_k"])
        window = np.outer(np.hanning(len(scores)), np.hanning(len(scores)))
        weight = constants["window_influence"]
        cell = np.unravel_index((penalty * scores * (1 - weight) + window * weight).argmax(), scores.shape)
        # as Python's floats, since float32 would round the place, and the next crop with it
        x0, y0, x1, y1, found_w, found_h = (float(v) for v in (*boxes[cell], w[cell], h[cell]))
        rate = constants["test_lr"] * float(penalty[cell]) * float(scores[cell])
        height, width = frame.shape[:2]
        self.cx = min(max(self.cx + ((x0 + x1) / 2 - size // 2) / scale, 0), width)
        self.cy = min(max(self.cy + ((y0 + y1) / 2 - size // 2) / scale, 0), height)
        self.w = min(max(self.w + (found_w / scale - self.w) * rate, self.smallest), width)
        self.h = min(max(self.h + (found_h / scale - self.h) * rate, self.smallest), height)
        return self.cx - (self.w - 1) / 2, self.cy - (self.h - 1) / 2, self.w, self.h


if __name__ == "__main__":
    video = cv2.VideoCapture(sys.argv[2])
    tracker, box = Minimal(sys.argv[1]), [float(v) for v in sys.argv[3].split(",")]
    tracker.init(video.read()[1], box)
    while (shot := video.read())[0]:
        print(*(f"{v:.2f}" for v in tracker.update(shot[1])), sep=",")

// A headset with two controllers in place of the browser's WebXR: tests set `emulated`. `hand` makes one a tracked hand.

(() => {
  const emulated = { visible: true, viewer: { x: 0, y: 1.6, z: 0 }, left: controller(-0.2), right: controller(0.2) };
  window.emulated = emulated;

  function controller(x) {
    return { position: { x, y: 1.2, z: -0.3 }, squeeze: 0, trigger: 0, tracked: true, pressed: [] };
  }

  function poseAt({ x, y, z }) {
    const matrix = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, y, z, 1]);
    const transform = { position: { x, y, z, w: 1 }, orientation: { x: 0, y: 0, z: 0, w: 1 }, matrix };
    return { transform: { ...transform, inverse: transform }, emulatedPosition: false };
  }

  class Session extends EventTarget {
    renderState = {};
    interactionMode = "world-space";
    environmentBlendMode = "opaque";
    get visibilityState() { return emulated.visible ? "visible" : "hidden"; }
    updateRenderState(state) { Object.assign(this.renderState, state); }
    async requestReferenceSpace() { return {}; }
    requestAnimationFrame(draw) { requestAnimationFrame((time) => this.ended || draw(time, new Frame(this))); }
    end() { this.ended = true; this.dispatchEvent(new Event("end")); }
    get inputSources() {
      return ["left", "right"].map((handedness) => {
        const { squeeze, trigger, pressed, hand } = emulated[handedness];
        if (hand) return { handedness, hand: { get: (joint) => ({ handedness, joint }) } };
        const buttons = [trigger, squeeze, 0, 0, 0, 0].map((value, i) => ({ value, pressed: value > 0.5 || pressed.includes(i) }));
        return { handedness, gripSpace: handedness, gamepad: { buttons } };
      });
    }
  }

  class Frame {
    constructor(session) { this.session = session; }
    getViewerPose() {
      const pose = poseAt(emulated.viewer);
      return { ...pose, views: [{ projectionMatrix: pose.transform.matrix, transform: pose.transform }] };
    }
    getPose(hand) {
      const { position, tracked } = emulated[hand];
      return tracked ? poseAt(position) : null;
    }
    // Fingers point away from the wrist: the middle finger bends onto its knuckle, the thumb meets the index finger.
    getJointPose({ handedness, joint }) {
      const { position: { x, y, z }, tracked, hand } = emulated[handedness];
      const away = { "middle-finger-phalanx-proximal": 0.09, "middle-finger-tip": hand.bent ? 0.09 : 0.18 }[joint];
      if (away) return tracked ? poseAt({ x, y, z: z - away }) : null;
      const aside = { "thumb-tip": 0.05, "index-finger-tip": hand.pinched ? 0.05 : -0.05 }[joint] ?? 0;
      return tracked ? poseAt({ x: x + aside, y, z }) : null;
    }
  }

  window.XRWebGLLayer = class {
    framebuffer = null;
    getViewport() { return { x: 0, y: 0, width: 16, height: 16 }; }
  };
  const xr = { isSessionSupported: async (mode) => mode === "immersive-vr", requestSession: async () => new Session() };
  Object.defineProperty(navigator, "xr", { value: xr });
})();

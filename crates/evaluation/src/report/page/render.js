// Drawing in three dimensions with WebGL 2: primitives, ground, water, one shadow. World: x forward, y left, z up.

caudata.mat = {
  mul(a, b) {
    const o = new Float32Array(16);
    for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[4 * k + r] * b[4 * c + k];
      o[4 * c + r] = sum;
    }
    return o;
  },
  perspective(fovy, aspect, near, far) {
    const f = 1 / Math.tan(fovy / 2), d = near - far;
    return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / d, -1, 0, 0, 2 * far * near / d, 0]);
  },
  ortho(half, near, far) {
    return new Float32Array([1 / half, 0, 0, 0, 0, 1 / half, 0, 0, 0, 0, -2 / (far - near), 0, 0, 0, -(far + near) / (far - near), 1]);
  },
  look(eye, at, up) {
    const unit = (v) => { const l = Math.hypot(...v) || 1; return v.map((x) => x / l); };
    const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const z = unit(caudata.sub(eye, at)), x = unit(cross(up, z)), y = cross(z, x);
    return new Float32Array([x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1]);
  },
};

// Meshes: [x y z nx ny nz …] and triangles.
caudata.meshes = {
  sphere(rings = 16, sides = 24) {
    const v = [], t = [];
    for (let i = 0; i <= rings; i++) for (let j = 0; j <= sides; j++) {
      const a = Math.PI * i / rings, b = 2 * Math.PI * j / sides;
      const p = [Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a)];
      v.push(...p, ...p);
    }
    const n = sides + 1;
    for (let i = 0; i < rings; i++) for (let j = 0; j < sides; j++) {
      const k = i * n + j;
      t.push(k, k + n, k + 1, k + 1, k + n, k + n + 1);
    }
    return [v, t];
  },
  // Along z from −1 to 1, radius 1 at the bottom and `top` at the top, with both ends.
  cylinder(top = 1, sides = 24) {
    const v = [], t = [];
    const slope = (1 - top) / 2, nz = slope / Math.hypot(1, slope), nr = 1 / Math.hypot(1, slope);
    for (let j = 0; j <= sides; j++) {
      const b = 2 * Math.PI * j / sides, c = Math.cos(b), s = Math.sin(b);
      v.push(c, s, -1, nr * c, nr * s, nz, top * c, top * s, 1, nr * c, nr * s, nz);
      if (j < sides) { const k = 2 * j; t.push(k, k + 2, k + 1, k + 1, k + 2, k + 3); }
    }
    for (const [z, r] of [[-1, 1], [1, top]]) {
      const middle = v.length / 6;
      v.push(0, 0, z, 0, 0, z);
      for (let j = 0; j <= sides; j++) {
        const b = 2 * Math.PI * j / sides;
        v.push(r * Math.cos(b), r * Math.sin(b), z, 0, 0, z);
        if (j < sides) z > 0 ? t.push(middle, middle + 1 + j, middle + 2 + j) : t.push(middle, middle + 2 + j, middle + 1 + j);
      }
    }
    return [v, t];
  },
  box() {
    const v = [], t = [];
    for (let axis = 0; axis < 3; axis++) for (const side of [-1, 1]) {
      const first = v.length / 6;
      for (const [a, b] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
        const p = [0, 0, 0], n = [0, 0, 0];
        p[axis] = side; n[axis] = side;
        p[(axis + 1) % 3] = a; p[(axis + 2) % 3] = b;
        v.push(...p, ...n);
      }
      side > 0 ? t.push(first, first + 1, first + 2, first, first + 2, first + 3) : t.push(first, first + 2, first + 1, first, first + 3, first + 2);
    }
    return [v, t];
  },
  plane() {
    return [[-1, -1, 0, 0, 0, 1, 1, -1, 0, 0, 0, 1, 1, 1, 0, 0, 0, 1, -1, 1, 0, 0, 0, 1], [0, 1, 2, 0, 2, 3]];
  },
  // A film's ground; facets along the same diagonal as in the simulator.
  terrain(grid) {
    const columns = grid.columns, rows = grid.heights.length / columns;
    const h = (ix, iy) => grid.heights[Math.max(0, Math.min(iy, rows - 1)) * columns + Math.max(0, Math.min(ix, columns - 1))];
    const v = [], t = [];
    for (let iy = 0; iy < rows; iy++) for (let ix = 0; ix < columns; ix++) {
      const n = [h(ix - 1, iy) - h(ix + 1, iy), h(ix, iy - 1) - h(ix, iy + 1), 2 * grid.cell_m];
      const l = Math.hypot(...n);
      v.push(grid.x0_m + ix * grid.cell_m, grid.y0_m + iy * grid.cell_m, h(ix, iy), n[0] / l, n[1] / l, n[2] / l);
      if (ix + 1 < columns && iy + 1 < rows) {
        const k = iy * columns + ix;
        t.push(k, k + 1, k + columns + 1, k, k + columns + 1, k + columns);
      }
    }
    return [v, t];
  },
};

caudata.shaders = {
  vertex: `#version 300 es
    in vec3 aPos; in vec3 aNormal;
    uniform mat4 uView, uLight; uniform vec4 uQuat; uniform vec3 uPos, uScale;
    out vec3 vWorld, vNormal; out vec4 vShade;
    vec3 turn(vec4 q, vec3 v) { return v + 2.0 * cross(q.yzw, cross(q.yzw, v) + q.x * v); }
    void main() {
      vWorld = uPos + turn(uQuat, uScale * aPos);
      vNormal = turn(uQuat, aNormal / uScale);
      vShade = uLight * vec4(vWorld, 1.0);
      gl_Position = uView * vec4(vWorld, 1.0);
    }`,
  fragment: `#version 300 es
    precision highp float;
    in vec3 vWorld, vNormal; in vec4 vShade;
    uniform vec3 uColor, uEye, uSun, uSky; uniform float uAlpha, uGround, uWater, uTime;
    uniform highp sampler2DShadow uShadow;
    out vec4 color;
    float lit() {
      vec3 s = vShade.xyz / vShade.w * 0.5 + 0.5;
      if (any(lessThan(s, vec3(0.0))) || any(greaterThan(s, vec3(1.0)))) return 1.0;
      float sum = 0.0, d = 1.0 / 2048.0;
      for (int i = -1; i <= 1; i++) for (int j = -1; j <= 1; j++)
        sum += texture(uShadow, vec3(s.xy + d * vec2(i, j), s.z - 0.0012));
      return sum / 9.0;
    }
    // Lines every 0.1 m, heavier every metre, fading where they get finer than a pixel.
    float line(float at, float every, float width) {
      float x = abs(fract(at / every - 0.5) - 0.5) * every, w = fwidth(at);
      return (1.0 - smoothstep(width, width + w, x)) * clamp(1.0 - 3.0 * w / every, 0.0, 1.0);
    }
    void main() {
      vec3 n = normalize(vNormal), look = normalize(uEye - vWorld);
      vec3 base = uColor;
      if (uGround > 0.5) {
        float fine = max(line(vWorld.x, 0.1, 0.0006), line(vWorld.y, 0.1, 0.0006));
        float coarse = max(line(vWorld.x, 1.0, 0.0025), line(vWorld.y, 1.0, 0.0025));
        base *= 1.0 - 0.10 * fine - 0.22 * coarse;
        if (uWater > -1e3) base = mix(base, vec3(0.62, 0.56, 0.42), 0.75 * smoothstep(0.16, 0.0, vWorld.z - uWater));
      }
      float alpha = uAlpha;
      vec3 c;
      if (uAlpha < 1.0) {
        float wave = sin(9.0 * vWorld.x + 1.3 * uTime) + sin(7.0 * vWorld.y - 1.1 * uTime) + sin(5.0 * (vWorld.x + vWorld.y) + 0.7 * uTime);
        n = normalize(n + vec3(0.012 * wave, 0.012 * cos(8.0 * vWorld.y + uTime), 0.0));
        float fresnel = pow(1.0 - max(dot(n, look), 0.0), 3.0);
        c = mix(base, uSky, 0.65 * fresnel) + 0.35 * pow(max(dot(reflect(-uSun, n), look), 0.0), 60.0);
        alpha = mix(uAlpha, 0.9, fresnel);
      } else {
        float shade = lit();
        float sun = max(dot(n, uSun), 0.0) * shade;
        vec3 ambient = mix(vec3(0.40, 0.38, 0.36), vec3(0.54, 0.58, 0.63), 0.5 + 0.5 * n.z);
        float gloss = uGround > 0.5 ? 0.0 : 0.22 * pow(max(dot(reflect(-uSun, n), look), 0.0), 24.0) * shade;
        c = base * (ambient + vec3(0.78, 0.74, 0.66) * sun) + gloss;
        // what lies under water takes its colour
        if (uWater > -1e3 && vWorld.z < uWater) c = mix(c, vec3(0.16, 0.38, 0.50), clamp(0.35 + 0.9 * (uWater - vWorld.z), 0.0, 0.75) * (uGround > 0.5 ? 1.0 : 0.35));
      }
      float far = length(uEye.xy - vWorld.xy);
      c = mix(c, uSky, uGround > 0.5 || uAlpha < 1.0 ? smoothstep(5.0, 16.0, far) : 0.0);
      color = vec4(c, alpha);
    }`,
  flat: `#version 300 es
    precision highp float; uniform vec3 uColor; out vec4 color; void main() { color = vec4(uColor, 1.0); }`,
  shadow: `#version 300 es
    precision highp float; void main() {}`,
};

caudata.Renderer = class {
  static SUN = (() => { const v = [0.35, 0.45, 0.82], l = Math.hypot(...v); return v.map((x) => x / l); })();
  static SKY = [0.76, 0.83, 0.87];
  static SHADOW = 2048;

  // Throws where there is no WebGL 2.
  constructor(canvas) {
    this.canvas = canvas;
    // Share of the screen's resolution; there are shadows only in the whole of it.
    this.detail = 1;
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: false });
    if (!gl) throw new Error("this browser offers no WebGL 2");
    this.gl = gl;
    this.main = this.program(caudata.shaders.vertex, caudata.shaders.fragment);
    this.plain = this.program(caudata.shaders.vertex, caudata.shaders.flat);
    this.depth = this.program(caudata.shaders.vertex, caudata.shaders.shadow);
    this.unit = {
      sphere: this.mesh(caudata.meshes.sphere()), cylinder: this.mesh(caudata.meshes.cylinder()),
      box: this.mesh(caudata.meshes.box()), cone: this.mesh(caudata.meshes.cylinder(0.001)), plane: this.mesh(caudata.meshes.plane()), dot: this.mesh(caudata.meshes.sphere(3, 6)),
    };
    this.shadowTarget();
    gl.enable(gl.DEPTH_TEST);
  }

  program(vertex, fragment) {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text.trim());
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "aPos");
    gl.bindAttribLocation(program, 1, "aNormal");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const at = {};
    const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
    for (let i = 0; i < count; i++) { const { name } = gl.getActiveUniform(program, i); at[name] = gl.getUniformLocation(program, name); }
    return { program, at };
  }

  mesh([vertices, triangles]) {
    const gl = this.gl, vao = gl.createVertexArray(), buffers = [gl.createBuffer(), gl.createBuffer()];
    gl.bindVertexArray(vao);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers[0]);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(vertices), gl.STATIC_DRAW);
    for (const [i, offset] of [[0, 0], [1, 12]]) { gl.enableVertexAttribArray(i); gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 24, offset); }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers[1]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(triangles), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { vao, buffers, count: triangles.length };
  }

  free(mesh) {
    this.gl.deleteVertexArray(mesh.vao);
    mesh.buffers.forEach((b) => this.gl.deleteBuffer(b));
  }

  shadowTarget() {
    const gl = this.gl, size = caudata.Renderer.SHADOW;
    this.shadowMap = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, this.shadowMap);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.DEPTH_COMPONENT24, size, size, 0, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
    for (const [name, value] of [[gl.TEXTURE_MIN_FILTER, gl.LINEAR], [gl.TEXTURE_MAG_FILTER, gl.LINEAR], [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE],
      [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE], [gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE], [gl.TEXTURE_COMPARE_FUNC, gl.LEQUAL]]) gl.texParameteri(gl.TEXTURE_2D, name, value);
    this.shadowFrame = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadowFrame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, this.shadowMap, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }

  // Follows the size of the canvas on the screen.
  resize() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2) * this.detail;
    const width = Math.max(1, Math.round(this.canvas.clientWidth * ratio)), height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    if (this.canvas.width !== width || this.canvas.height !== height) { this.canvas.width = width; this.canvas.height = height; }
    return width / height;
  }

  one(shader, item) {
    const gl = this.gl, { at } = shader;
    gl.uniform3fv(at.uPos, item.pos || [0, 0, 0]);
    gl.uniform4fv(at.uQuat, item.quat || [1, 0, 0, 0]);
    gl.uniform3fv(at.uScale, item.scale || [1, 1, 1]);
    if (at.uColor) gl.uniform3fv(at.uColor, item.color);
    if (at.uAlpha) gl.uniform1f(at.uAlpha, item.alpha || 1);
    if (at.uGround) gl.uniform1f(at.uGround, item.ground ? 1 : 0);
    gl.bindVertexArray(item.mesh.vao);
    gl.drawElements(gl.TRIANGLES, item.mesh.count, gl.UNSIGNED_INT, 0);
  }

  // items: {mesh, pos, quat, scale, color, alpha, ground, glow, ghost}; camera: {eye, target}; water: height or null; time in s.
  draw(items, camera, water, time) {
    const gl = this.gl, { mat } = caudata, { SUN, SKY, SHADOW } = caudata.Renderer;
    const aspect = this.resize();
    const from = caudata.add(camera.target, SUN.map((x) => 6 * x));
    const light = mat.mul(mat.ortho(1.7, 1, 12), mat.look(from, camera.target, [1, 0, 0]));
    const view = mat.mul(mat.perspective(caudata.Scene.FOV, aspect, 0.03, 60), mat.look(camera.eye, camera.target, [0, 0, 1]));

    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadowFrame);
    gl.viewport(0, 0, SHADOW, SHADOW);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.depth.program);
    gl.uniformMatrix4fv(this.depth.at.uView, false, light);
    for (const item of items) if (this.detail === 1 && !item.ground && !item.alpha && !item.glow) this.one(this.depth, item);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(...SKY, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.main.program);
    const { at } = this.main;
    gl.uniformMatrix4fv(at.uView, false, view);
    gl.uniformMatrix4fv(at.uLight, false, light);
    gl.uniform3fv(at.uEye, camera.eye);
    gl.uniform3fv(at.uSun, SUN);
    gl.uniform3fv(at.uSky, SKY);
    gl.uniform1f(at.uWater, water === null ? -1e4 : water);
    gl.uniform1f(at.uTime, time);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.shadowMap);
    gl.uniform1i(at.uShadow, 0);
    for (const item of items) if (!item.alpha && !item.glow) this.one(this.main, item);

    gl.useProgram(this.plain.program);
    gl.uniformMatrix4fv(this.plain.at.uView, false, view);
    for (const item of items) if (item.glow) this.one(this.plain, item);

    gl.useProgram(this.main.program);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.depthMask(false);
    for (const item of items) if (item.alpha) this.one(this.main, item);
    gl.depthMask(true);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(null);
  }
};

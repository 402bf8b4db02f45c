// The closed loop solved in the page: LPV surfaces, actuators, Pade delays, low-pass and P gains in; modes, sensitivity and
// impact response out. Plain functions of plain arrays, no page in here. A matrix is an array of rows, a complex number [re, im].
"use strict";

const ExplorerMath = (() => {
  const zeros = (n, m) => Array.from({ length: n }, () => new Float64Array(m));
  const identity = (n) => zeros(n, n).map((row, i) => ((row[i] = 1), row));

  // ---------------------------------------------------------------- the model at an operating point (Eqs. 16 to 20)

  // The six terms of Eq. 16.
  const terms = (P, Omega) => [1, P, Omega, Omega * P, P * P, Omega * Omega];

  function keyParameters(model, P, Omega) {
    const t = terms(P, Omega);
    const values = {};
    for (const [name, c] of Object.entries(model.coefficients)) values[name] = c.reduce((sum, ci, i) => sum + ci * t[i], 0);
    return values;
  }

  // Numerator and denominator of the Pade approximation of exp(-tau s), ascending powers, leading coefficient of the denominator 1.
  function pade(tau, order) {
    const c = [];
    for (let k = 0; k <= order; k++) {
      let value = 1;
      for (let j = 0; j < k; j++) value *= (order - j) / ((2 * order - j) * (j + 1));
      c.push(value * tau ** k);
    }
    const lead = c[order];
    return { num: c.map((v, k) => ((k % 2 ? -v : v) / lead)), den: c.map((v) => v / lead) };
  }

  // System matrix of the whole loop. States: p, its velocity, delay x, delay y, (a, u) of each axis, low-pass of each axis.
  function closedLoop(model, s) {
    const q = keyParameters(model, s.pressure, s.speed);
    const order = model.pade_order;
    const n = 4 + 2 * order + 4 + 2;
    const A = zeros(n, n);
    const axes = ["x", "y"];
    const delayAt = [4, 4 + order];
    const actuatorAt = [4 + 2 * order, 6 + 2 * order];
    const filterAt = [8 + 2 * order, 9 + 2 * order];
    const corner = 2 * Math.PI * s.corner;
    for (let i = 0; i < 2; i++) {
      A[i][2 + i] = 1;
      for (let j = 0; j < 2; j++) {
        A[2 + i][j] = q[`k_${axes[i]}${axes[j]}`];
        A[2 + i][2 + j] = q[`d_${axes[i]}${axes[j]}`];
      }
    }
    for (let j = 0; j < 2; j++) {
      const axis = axes[j];
      const { num, den } = pade(q[`tau_${axis}`], order);
      const at = delayAt[j];
      const u = actuatorAt[j] + 1;
      for (let k = 0; k + 1 < order; k++) A[at + k][at + k + 1] = 1;
      for (let k = 0; k < order; k++) A[at + order - 1][at + k] = -den[k];
      A[at + order - 1][u] = 1;
      for (let i = 0; i < 2; i++) {
        const b = q[`b_${axes[i]}${axis}`];
        for (let k = 0; k < order; k++) A[2 + i][at + k] += b * (num[k] - num[order] * den[k]);
        A[2 + i][u] += b * num[order];
      }
      const p1 = model.actuators[`p1_${axis}`];
      const p2 = model.actuators[`p2_${axis}`];
      const kappa = model.actuators[`kappa_${axis}`];
      A[actuatorAt[j]][actuatorAt[j]] = -p1;
      A[actuatorAt[j]][filterAt[j]] = p1 * kappa * s.gains[j];
      A[u][actuatorAt[j]] = p2;
      A[u][u] = -p2;
      A[filterAt[j]][filterAt[j]] = -corner;
      A[filterAt[j]][j] = corner;
    }
    return A;
  }

  // ---------------------------------------------------------------- eigenvalues: balance, Hessenberg form, shifted QR

  // Scale the states of A in place, by powers of two, so that rows and columns are of like size; return the scales.
  function balance(A) {
    const n = A.length;
    const scales = new Float64Array(n).fill(1);
    for (let settled = false; !settled; ) {
      settled = true;
      for (let i = 0; i < n; i++) {
        let c = 0;
        let r = 0;
        for (let j = 0; j < n; j++) {
          if (j !== i) {
            c += Math.abs(A[j][i]);
            r += Math.abs(A[i][j]);
          }
        }
        if (c === 0 || r === 0) continue;
        const before = c + r;
        let f = 1;
        for (; c < r / 2; c *= 4) f *= 2;
        for (; c >= r * 2; c /= 4) f /= 2;
        if ((c + r) / f < 0.95 * before) {
          settled = false;
          for (let j = 0; j < n; j++) A[i][j] /= f;
          for (let j = 0; j < n; j++) A[j][i] *= f;
          scales[i] *= f;
        }
      }
    }
    return scales;
  }

  function hessenberg(A) {
    const n = A.length;
    for (let m = 1; m < n - 1; m++) {
      let pivot = m;
      for (let i = m; i < n; i++) if (Math.abs(A[i][m - 1]) > Math.abs(A[pivot][m - 1])) pivot = i;
      if (A[pivot][m - 1] === 0) continue;
      if (pivot !== m) {
        [A[pivot], A[m]] = [A[m], A[pivot]];
        for (const row of A) [row[pivot], row[m]] = [row[m], row[pivot]];
      }
      for (let i = m + 1; i < n; i++) {
        const y = A[i][m - 1] / A[m][m - 1];
        if (y === 0) continue;
        for (let j = 0; j < n; j++) A[i][j] -= y * A[m][j];
        for (const row of A) row[m] += y * row[i];
        A[i][m - 1] = 0;
      }
    }
  }

  // Francis's implicit double shift on a Hessenberg matrix, eigenvalues only.
  function shiftedQr(H) {
    const n = H.length;
    const values = [];
    let scale = 0;
    for (let i = 0; i < n; i++) for (let j = Math.max(0, i - 1); j < n; j++) scale += Math.abs(H[i][j]);
    let shift = 0;
    let high = n - 1;
    let rounds = 0;
    while (high >= 0) {
      let low = high;
      for (; low > 0; low--) {
        const size = Math.abs(H[low - 1][low - 1]) + Math.abs(H[low][low]) || scale;
        if (Math.abs(H[low][low - 1]) <= Number.EPSILON * size) {
          H[low][low - 1] = 0;
          break;
        }
      }
      let x = H[high][high];
      if (low === high) {
        values.push([x + shift, 0]);
        high -= 1;
        rounds = 0;
        continue;
      }
      let y = H[high - 1][high - 1];
      let w = H[high][high - 1] * H[high - 1][high];
      if (low === high - 1) {
        const half = (y - x) / 2;
        const discriminant = half * half + w;
        const root = Math.sqrt(Math.abs(discriminant));
        x += shift;
        if (discriminant >= 0) {
          const z = half + (half >= 0 ? root : -root);
          values.push([x + z, 0], [z !== 0 ? x - w / z : x + z, 0]);
        } else {
          values.push([x + half, root], [x + half, -root]);
        }
        high -= 2;
        rounds = 0;
        continue;
      }
      if (rounds >= 60) throw new Error("the eigenvalues did not converge");
      if (rounds > 0 && rounds % 10 === 0) {
        shift += x;
        for (let i = 0; i <= high; i++) H[i][i] -= x;
        const s = Math.abs(H[high][high - 1]) + Math.abs(H[high - 1][high - 2]);
        x = y = 0.75 * s;
        w = -0.4375 * s * s;
      }
      rounds += 1;
      let p;
      let q;
      let r;
      let start = high - 2;
      for (; start >= low; start--) {
        const z = H[start][start];
        const dx = x - z;
        const dy = y - z;
        p = (dx * dy - w) / H[start + 1][start] + H[start][start + 1];
        q = H[start + 1][start + 1] - z - dx - dy;
        r = H[start + 2][start + 1];
        const size = Math.abs(p) + Math.abs(q) + Math.abs(r);
        p /= size;
        q /= size;
        r /= size;
        if (start === low) break;
        const left = Math.abs(H[start][start - 1]) * (Math.abs(q) + Math.abs(r));
        const near = Math.abs(H[start - 1][start - 1]) + Math.abs(z) + Math.abs(H[start + 1][start + 1]);
        if (left <= Number.EPSILON * Math.abs(p) * near) break;
      }
      for (let i = start + 2; i <= high; i++) {
        H[i][i - 2] = 0;
        if (i > start + 2) H[i][i - 3] = 0;
      }
      for (let k = start; k < high; k++) {
        const last = k === high - 1;
        let size = 1;
        if (k > start) {
          p = H[k][k - 1];
          q = H[k + 1][k - 1];
          r = last ? 0 : H[k + 2][k - 1];
          size = Math.abs(p) + Math.abs(q) + Math.abs(r);
          if (size === 0) continue;
          p /= size;
          q /= size;
          r /= size;
        }
        const s = (p < 0 ? -1 : 1) * Math.sqrt(p * p + q * q + r * r);
        if (k > start) H[k][k - 1] = -s * size;
        else if (low !== start) H[k][k - 1] = -H[k][k - 1];
        p += s;
        const fx = p / s;
        const fy = q / s;
        const fz = r / s;
        q /= p;
        r /= p;
        for (let j = k; j <= high; j++) {
          const t = H[k][j] + q * H[k + 1][j] + (last ? 0 : r * H[k + 2][j]);
          H[k][j] -= t * fx;
          H[k + 1][j] -= t * fy;
          if (!last) H[k + 2][j] -= t * fz;
        }
        for (let i = low; i <= Math.min(high, k + 3); i++) {
          const t = fx * H[i][k] + fy * H[i][k + 1] + (last ? 0 : fz * H[i][k + 2]);
          H[i][k] -= t;
          H[i][k + 1] -= t * q;
          if (!last) H[i][k + 2] -= t * r;
        }
      }
    }
    return values;
  }

  // Eigenvalues [re, im] of a real matrix, slowest first.
  function eigenvalues(matrix) {
    const A = matrix.map((row) => Float64Array.from(row));
    balance(A);
    hessenberg(A);
    return shiftedQr(A).sort((a, b) => Math.hypot(...a) - Math.hypot(...b) || b[1] - a[1]);
  }

  // Oscillatory modes as {frequency [Hz], damping}, real poles as {pole [1/s]}, and whether all of them decay.
  function modes(model, settings) {
    const values = eigenvalues(closedLoop(model, settings));
    const oscillatory = values
      .filter(([, im]) => im > 0)
      .map(([re, im]) => ({ frequency: Math.hypot(re, im) / (2 * Math.PI), damping: -re / Math.hypot(re, im), re, im }));
    const real = values.filter(([, im]) => im === 0).map(([re]) => re);
    return { values, oscillatory, real, stable: values.every(([re]) => re < 0) };
  }

  // ---------------------------------------------------------------- output sensitivity S_o = (I - G K)^-1 (Eq. 22)

  const add = (a, b) => [a[0] + b[0], a[1] + b[1]];
  const sub = (a, b) => [a[0] - b[0], a[1] - b[1]];
  const mul = (a, b) => [a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]];
  const div = (a, b) => {
    const size = b[0] * b[0] + b[1] * b[1];
    return [(a[0] * b[0] + a[1] * b[1]) / size, (a[1] * b[0] - a[0] * b[1]) / size];
  };
  const real = (x) => [x, 0];
  const along = (coefficients, s) => coefficients.reduceRight((sum, c) => add(mul(sum, s), real(c)), [0, 0]);

  function inverse2(M) {
    const det = sub(mul(M[0][0], M[1][1]), mul(M[0][1], M[1][0]));
    return [
      [div(M[1][1], det), div(mul(real(-1), M[0][1]), det)],
      [div(mul(real(-1), M[1][0]), det), div(M[0][0], det)],
    ];
  }

  function sensitivityAt(model, settings, frequency) {
    const s = [0, 2 * Math.PI * frequency];
    const q = keyParameters(model, settings.pressure, settings.speed);
    const axes = ["x", "y"];
    const dynamic = axes.map((a, i) =>
      axes.map((b, j) => {
        const rest = add(real(-q[`k_${a}${b}`]), mul(real(-q[`d_${a}${b}`]), s));
        return i === j ? add(mul(s, s), rest) : rest;
      }),
    );
    const compliance = inverse2(dynamic);
    const corner = 2 * Math.PI * settings.corner;
    const chain = axes.map((a, j) => {
      const { num, den } = pade(q[`tau_${a}`], model.pade_order);
      const delay = div(along(num, s), along(den, s));
      const slow = div(real(model.actuators[`p1_${a}`]), add(s, real(model.actuators[`p1_${a}`])));
      const fast = div(real(model.actuators[`p2_${a}`]), add(s, real(model.actuators[`p2_${a}`])));
      const filter = div(real(corner * settings.gains[j] * model.actuators[`kappa_${a}`]), add(s, real(corner)));
      return mul(mul(delay, filter), mul(slow, fast));
    });
    const loop = axes.map((a, i) =>
      axes.map((b, j) => {
        const gain = axes.reduce((sum, c, k) => add(sum, mul(compliance[i][k], real(q[`b_${c}${b}`]))), [0, 0]);
        const value = mul(real(-1), mul(gain, chain[j]));
        return i === j ? add(value, real(1)) : value;
      }),
    );
    return inverse2(loop);
  }

  // Largest singular value of a complex 2 x 2 matrix.
  function largestSingularValue(M) {
    const size = M.flat().reduce((sum, [re, im]) => sum + re * re + im * im, 0);
    const det = sub(mul(M[0][0], M[1][1]), mul(M[0][1], M[1][0]));
    const d = det[0] * det[0] + det[1] * det[1];
    return Math.sqrt((size + Math.sqrt(Math.max(size * size - 4 * d, 0))) / 2);
  }

  function sensitivity(model, settings, frequencies) {
    const matrices = frequencies.map((f) => sensitivityAt(model, settings, f));
    return {
      largest: matrices.map(largestSingularValue),
      xx: matrices.map((M) => Math.hypot(...M[0][0])),
      yy: matrices.map((M) => Math.hypot(...M[1][1])),
    };
  }

  // ---------------------------------------------------------------- response to a hammer

  function multiply(A, B) {
    const C = zeros(A.length, B[0].length);
    for (let i = 0; i < A.length; i++) {
      for (let k = 0; k < B.length; k++) {
        const a = A[i][k];
        if (a !== 0) for (let j = 0; j < C[0].length; j++) C[i][j] += a * B[k][j];
      }
    }
    return C;
  }

  // exp(A t): Taylor series of the balanced matrix scaled below one half, squared back. Without balance a Pade filter of a short
  // delay (coefficients of 1 / tau^order) would take tens of squarings, each of which doubles the rounding.
  function exponential(matrix, t) {
    const A = matrix.map((row) => Float64Array.from(row));
    const scales = balance(A);
    const n = A.length;
    const size = Math.max(...A.map((row) => row.reduce((sum, v) => sum + Math.abs(v * t), 0)));
    const squarings = Math.max(0, Math.ceil(Math.log2(size)) + 1);
    const scaled = A.map((row) => row.map((v) => (v * t) / 2 ** squarings));
    let sum = identity(n);
    let term = identity(n);
    for (let k = 1; k <= 18; k++) {
      term = multiply(term, scaled).map((row) => row.map((v) => v / k));
      sum = sum.map((row, i) => row.map((v, j) => v + term[i][j]));
    }
    for (let k = 0; k < squarings; k++) sum = multiply(sum, sum);
    return sum.map((row, i) => row.map((v, j) => (v * scales[i]) / scales[j]));
  }

  const apply = (M, x) => M.map((row) => row.reduce((sum, v, j) => sum + v * x[j], 0));

  // Disc position [m] after a half-sine force: impact {axis 0 or 1, peak [N], duration [s], mass [kg]}, at `count` instants `step` apart.
  // The pulse is made by two more states, a harmonic oscillator, so that the answer is exact at every instant.
  function impactResponse(model, settings, impact, step, count) {
    const loop = closedLoop(model, settings);
    const n = loop.length;
    const rate = Math.PI / impact.duration;
    const A = zeros(n + 2, n + 2);
    loop.forEach((row, i) => A[i].set(row));
    A[2 + impact.axis][n] = impact.peak / impact.mass;
    A[n][n + 1] = rate;
    A[n + 1][n] = -rate;
    const struck = new Float64Array(n + 2);
    struck[n + 1] = 1;
    const free = exponential(loop, step);
    const positions = [];
    let state = null;
    let pushed = struck;
    const driven = exponential(A, step);
    for (let k = 0; k < count; k++) {
      const t = k * step;
      if (t < impact.duration) {
        positions.push([pushed[0], pushed[1]]);
        pushed = apply(driven, pushed);
        continue;
      }
      if (state === null) {
        const whole = apply(exponential(A, impact.duration), struck).slice(0, n);
        state = apply(exponential(loop, t - impact.duration), whole);
      } else {
        state = apply(free, state);
      }
      positions.push([state[0], state[1]]);
    }
    return positions;
  }

  return { keyParameters, closedLoop, eigenvalues, modes, sensitivity, sensitivityAt, largestSingularValue, impactResponse, exponential };
})();

if (typeof module !== "undefined") module.exports = ExplorerMath;

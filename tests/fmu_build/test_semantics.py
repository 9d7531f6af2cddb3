"""Small cases with values that follow from the Modelica specification by hand.

Each group is a package `P` with a model `M`; each case names a variable of it and its value at the start, or at the
times of the group, at which the events are settled one after the other.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from fmu_build import compile_modelica
from fmu_build.model import CompiledModel
from tests.fmu_build.simulate import Instance, find

GROUPS: dict[str, tuple[str, dict[str, float]]] = {
    # specification 7.2: modifications, the outermost wins
    "modifiers": (
        """
        model A parameter Real k = 1; parameter Real j = 10*k; Real y = k + j; end A;
        model B A a(k = 2); end B;
        model C extends B(a(k = 3)); end C;
        model D extends C; end D;
        model W parameter Real k = 7; A a(k = k); A b(k = 2*k); end W;
        type T = Real(start = 4, min = -1);
        model S T x(start = 5); T y; initial equation x = x.start; end S;
        model V parameter Real p[3] = {1, 2, 3}; parameter Real q[2, 2] = fill(4, 2, 2); end V;
        model Sub parameter Real r = 1; end Sub;
        model Arr Sub s[3](r = {1, 2, 3}); Sub e[2](each r = 9); Sub one[2]; end Arr;
        model Outer Arr a[2](s(r = {{1, 2, 3}, {4, 5, 6}})); end Outer;
        model Keep parameter Real k = 1; parameter Real m = k; end Keep;
        model M
          A a; A a2(k = 5); A a3(j = 6); B b; B b2(a(k = 8)); B b3(a.k = 9); C c; C c2(a(j = 1)); D d; W w; W w2(k = 1);
          W w3(a(k = 100)); V v; V v2(p = {4, 5, 6}); V v3(p(start = 0) = {7, 7, 7}, q = [1, 2; 3, 4]);
          Arr arr; Arr arr2(s(r = {10, 20, 30})); Arr arr3(s(each r = 6)); Arr arr4(s.r = {7, 8, 9}); Outer o;
          parameter Real k = 50; A scoped(k = k + 1); Keep keep(k(min = 0) = 3, final m = 4);
        end M;
        """,
        {
            "a.k": 1, "a.j": 10, "a.y": 11, "a2.j": 50, "a2.y": 55, "a3.j": 6, "a3.y": 7, "b.a.k": 2, "b.a.y": 22,
            "b2.a.k": 8, "b3.a.k": 9, "b3.a.j": 90, "c.a.k": 3, "c2.a.y": 4, "d.a.j": 30, "w.a.k": 7, "w.b.k": 14,
            "w2.b.y": 22, "w3.a.k": 100, "w3.b.k": 14, "v.p[2]": 2, "v2.p[3]": 6, "v3.p[1]": 7, "v3.q[2,1]": 3,
            "v.q[1,2]": 4, "arr.s[2].r": 2, "arr.e[1].r": 9, "arr.one[2].r": 1, "arr2.s[3].r": 30,
            "arr3.s[1].r": 6, "arr4.s[2].r": 8, "o.a[1].s[3].r": 3, "o.a[2].s[1].r": 4, "scoped.k": 51,
            "scoped.j": 510, "keep.k": 3, "keep.m": 4,
        },
    ),
    # specification 7.2.5: a vector for each element
    "records of arrays in modifications": (
        """
        record Cell parameter Real R[2] = {1, 1}; parameter Real T = 3; end Cell;
        record Data parameter Integer n = 2; Cell rc[n](R = {{1, 2}, {3, 4}}); end Data;
        model Two parameter Real R[2]; Real y = R[1] + 10*R[2]; end Two;
        model M parameter Data d; Cell r[d.n](R = d.rc.R); Two two[d.n](R = d.rc.R); end M;
        """,
        {"r[2].R[1]": 3, "r[1].R[2]": 2, "r[2].T": 3, "two[2].y": 43},
    ),
    # specification 7.3: redeclarations, constraining clauses
    "redeclarations": (
        """
        model Pc parameter Real k = 1; parameter Real lim = 10; parameter Real own = 0; end Pc;
        model Ctl extends Pc(k = 20); end Ctl;
        model Other extends Pc(lim = 30, own = 5); parameter Real more = 7; end Other;
        model U replaceable Pc c constrainedby Pc(final k = 4, lim = 2); end U;
        model N replaceable Pc c(k = 4); end N;
        model L replaceable model Law = Pc(k = 6); Law law; end L;
        model Lc replaceable model Law = Pc(k = 6) constrainedby Pc(lim = 3); Law law; Law two(own = 1); end Lc;
        model In extends U; end In;
        model Deep In i; end Deep;
        model Body extends U; redeclare Ctl c; end Body;
        model BodyM extends U; redeclare Other c(own = 8); end BodyM;
        model Ext extends L; redeclare model extends Law parameter Real extra = 11; end Law; end Ext;
        model Sized replaceable Pc c[2](k = {1, 2}); end Sized;
        model M
          U u; U u2(redeclare Ctl c); U u3(redeclare Other c(lim = 99)); U u4(redeclare Other c);
          N n; N n2(redeclare Other c); N n3(redeclare Other c(k = 40));
          L l; L l2(redeclare model Law = Other); L l3(redeclare model Law = Other(k = 12)); L l4(law(k = 1));
          Lc lc; Lc lc2(redeclare model Law = Other); Lc lc3(redeclare model Law = Other(lim = 8));
          In in1(redeclare Other c); Deep deep(i(redeclare Other c)); Body body; BodyM bodyM; Ext ext;
          Sized sized(redeclare Other c); Deep deep2(i.c.lim = 5);
        end M;
        """,
        {
            "u.c.k": 4, "u.c.lim": 2, "u2.c.k": 4, "u2.c.lim": 2, "u3.c.lim": 99, "u3.c.k": 4, "u4.c.lim": 2,
            "u4.c.own": 5, "u4.c.more": 7, "n.c.k": 4, "n2.c.k": 4, "n2.c.own": 5, "n3.c.k": 40, "l.law.k": 6,
            "l2.law.k": 6, "l2.law.lim": 30, "l3.law.k": 12, "l4.law.k": 1, "lc.law.k": 6, "lc.law.lim": 3,
            "lc2.law.k": 1, "lc2.law.lim": 3, "lc2.law.own": 5, "lc2.two.own": 1, "lc3.law.lim": 8, "in1.c.own": 5,
            "in1.c.lim": 2, "deep.i.c.more": 7, "body.c.k": 4, "bodyM.c.own": 8, "ext.law.extra": 11,
            "ext.law.k": 6, "sized.c[2].k": 2, "sized.c[1].own": 5, "deep2.i.c.lim": 5,
        },
    ),
    # packages: redeclared side by side, with modifications, lookup through them
    "packages": (
        """
        package Motor constant Real R = 5; constant Real K[2] = {R, 2*R};
          function loss input Real i; output Real p; algorithm p := R*i^2; end loss; end Motor;
        package Big extends Motor(R = 0.1); end Big;
        package Short = Motor(R = 3);
        partial package Law constant Real n = 1; replaceable partial function f input Real v; output Real y; end f;
          function twice input Real v; output Real y; algorithm y := 2*f(v); end twice; end Law;
        package Linear extends Law(n = 2);
          redeclare function extends f algorithm y := n*v; end f; end Linear;
        package Quadratic extends Law;
          redeclare function extends f algorithm y := v*abs(v); end f; end Quadratic;
        model Friction replaceable package Lw = Linear constrainedby Law; parameter Real v = 3;
          Real y = Lw.f(v); Real z = Lw.twice(v); Real n = Lw.n; end Friction;
        package Nested constant Real c = 4; package Inner constant Real d = c + 1;
          model Q Real y = c*d; end Q; end Inner; end Nested;
        package Imported import P.Nested.Inner; import N = P.Nested; import P.Nested.Inner.*;
          model R Inner.Q q; Real y = N.c; Q q2; Real z = d; end R; end Imported;
        package Both import P.Nested.{c, Inner}; model R Real y = c + Inner.d; end R; end Both;
        encapsulated package Closed import P; constant Real k = P.Nested.c; end Closed;
        constant Real shadow = 1;
        model Sh constant Real shadow = 2; model In Real y = shadow; end In; In i; Real top = P.shadow; end Sh;
        model BaseOfOther Real y = shadow; end BaseOfOther;
        model Capture extends BaseOfOther; parameter Real other = 3; end Capture;
        type Kind = enumeration(slow "s", fast); model Literals import P.Kind.fast; import f = P.Kind.slow; parameter Kind kind = fast;
          Real one = if kind == fast and kind <> f then 1 else 0; end Literals; record Rec Real a = 1; Real b = 2; end Rec;
        constant Rec rec = Rec(a = 8); constant Rec recs = Rec(b = rec.a);
        model M
          Real big = Big.R; Real motor = Motor.R; Real short = Short.R; Real bigK = Big.K[2]; Real motorK = Motor.K[2];
          Real lossBig = Big.loss(2); Real lossMotor = Motor.loss(2); Real lossShort = Short.loss(2);
          Friction a; Friction b(redeclare package Lw = Quadratic); Friction c(redeclare package Lw = Linear(n = 10));
          Imported.R r; Both.R both; Real closed = Closed.k; Sh sh; Capture capture;
          parameter Kind kind = Kind.fast; Real isFast = if kind == Kind.fast then 1 else 0; Real ord = Integer(kind);
          Real recA = rec.a; Real recB = recs.b; Real deep = P.Nested.Inner.d; Literals literals;
        end M;
        """,
        {
            "big": 0.1, "motor": 5, "short": 3, "bigK": 0.2, "motorK": 10, "lossBig": 0.4, "lossMotor": 20,
            "lossShort": 12, "a.y": 6, "a.z": 12, "a.n": 2, "b.y": 9, "b.z": 18, "b.n": 1, "c.y": 30, "c.n": 10,
            "r.q.y": 20, "r.y": 4, "r.q2.y": 20, "r.z": 5, "both.y": 9, "closed": 4, "sh.i.y": 2, "sh.top": 1,
            "capture.y": 1, "isFast": 1, "ord": 2, "recA": 8, "recB": 8, "deep": 5, "literals.one": 1,
        },
    ),
    # specification 10: arrays
    # specification 10.4.2, 10.6.7, 12.9.1, 9.4.1
    "powers of matrices, cat of arrays, names of literals, terminal": (
        """
        type E = enumeration(one, two);
        model M
          parameter Real a[2, 2] = [1, 2; 3, 4]; Real b[2, 2] = a^3; Real c[2, 2] = a^0;
          Real d[1, 2, 2] = cat(3, {{{1}, {2}}}, {{{3}, {4}}}); Real e[2, 2] = cat(1, a[1:1, :], a[2:2, :]);
          Real s = if String(E.two) == "two" then 1 else 0; Real t = if terminal() then 1 else 0;
        end M;
        """,
        {"b[1,1]": 37, "b[1,2]": 54, "b[2,1]": 81, "b[2,2]": 118, "c[1,1]": 1, "c[1,2]": 0, "d[1,1,2]": 3,
         "d[1,2,1]": 2, "e[2,1]": 3, "s": 1, "t": 0},
    ),
    # specification 15.2: two, three and unconnected ports, and a connection from outside to inside
    "streams": (
        """
        connector Port Real p; flow Real m; stream Real h; end Port;
        model Source Port a; parameter Real m = 1; parameter Real h = 7; equation a.m = -m; a.h = h; end Source;
        model Sink Port a; parameter Real h = 3; Real x = inStream(a.h); Real y = actualStream(a.h);
        equation a.p = 1; a.h = h; end Sink;
        model Box Port a; Sink sink; equation connect(a, sink.a); end Box;
        model M
          Source s; Sink k; Source s1(m = 1, h = 10); Source s2(m = 3, h = 20); Sink both; Sink loose; Source far; Box box;
        equation
          connect(s.a, k.a); connect(s1.a, both.a); connect(s2.a, both.a); connect(far.a, box.a);
        end M;
        """,
        {"k.x": 7, "k.y": 7, "both.x": 17.5, "loose.x": 3, "box.sink.x": 7, "box.a.h": 3},
    ),
    "flows of record type": (
        """
        record C Real re; Real im; end C;
        connector Pin C v; flow C i; end Pin;
        model Z Pin p; parameter C y = C(1, 2); equation p.i.re = y.re*p.v.re; p.i.im = y.im*p.v.im; end Z;
        model U Pin p; equation p.v.re = 3; p.v.im = 4; end U;
        model M Z a; Z b; U u; Pin loose; equation connect(u.p, a.p); connect(u.p, b.p); loose.v.re = 1; loose.v.im = 2; end M;
        """,
        {"u.p.i.re": -6, "u.p.i.im": -16, "loose.i.re": 0},
    ),
    "types with a direction in functions": (
        """
        type In = input Real; type Out = output Real;
        function f In u; Out y; algorithm y := 2*u; end f;
        model M Real x = f(3); end M;
        """,
        {"x": 6},
    ),
    "arrays": (
        """
        model El parameter Real k = 1; Real y = k; end El;
        function mean input Real u[:]; output Real y; algorithm y := sum(u)/size(u, 1); end mean;
        function outer2 input Real a[:]; input Real b[:]; output Real c[size(a, 1), size(b, 1)];
          algorithm for i in 1:size(a, 1) loop for j in 1:size(b, 1) loop c[i, j] := a[i]*b[j]; end for; end for; end outer2;
        model M
          parameter Integer n = 3; parameter Real A[2, 3] = [1, 2, 3; 4, 5, 6]; parameter Real open[:] = {5, 6, 7, 8};
          Real rows = size(A, 1); Real columns = size(A, 2); Real length = size(open, 1); Real last = open[end];
          Real part[2] = open[2:3]; Real step[2] = open[{1, 3}]; Real column[2] = A[:, 2]; Real row[3] = A[2, :];
          Real prod = A[1, :]*A[2, :]; Real vec[2] = A*{1, 0, 1}; Real back[3] = {1, 1}*A; Real t = (transpose(A))[3, 1];
          Real total = sum(A); Real most = max(A); Real least = min({3, -4, 5}); Real scaled[2] = 2*{1, 2} - {1, 1};
          Real compr[3] = {i^2 for i in 1:n}; Real red = sum(i*j for i in 1:2, j in 1:3); Real two[2, 3] = {{10*j + i for i in 1:3} for j in 1:2};
          Real nested[3, 2] = {10*i + j for j in 1:2, i in 1:3};
          El e[n](k = {i + 0.5 for i in 1:n}); Real slice = sum(e.y); Real some = sum(e[2:3].y); Real lastE = e[end].y;
          Real zero = sum(zeros(0)); Real m = mean({1, 2, 6}); Real out = (outer2({1, 2}, {3, 4, 5}))[2, 3];
          Real lin[3] = linspace(1, 2, 3); Real id = sum(identity(3)); Real c3[3] = cross({1, 0, 0}, {0, 1, 0});
          Real cat1 = sum(cat(1, {1, 2}, {3})); Real cat2[2, 2] = cat(2, [1; 2], [3; 4]); Real elementwise[2] = {6, 8} ./ {2, 4};
          Real pick = ({10, 20, 30})[2]; Real fromRange = sum(1:2:7); Real down = sum(3:-1:1); Real g[2];
          Real diag = (diagonal({2, 3}))[2, 2]; Real nd = ndims(A); Real op = (outerProduct({1, 2}, {3, 4}))[2, 1]; Real powers[2] = {2, 3} .^ 2;
          Real vectorised[2] = abs({-1, 2}); Real implied[3];
        equation
          for k in 1:2 loop g[k] = k*A[k, k]; end for;
          for k loop implied[k] = 2*k; end for;
        end M;
        """,
        {
            "rows": 2, "columns": 3, "length": 4, "last": 8, "part[2]": 7, "step[2]": 7, "column[1]": 2, "row[3]": 6,
            "prod": 32, "vec[2]": 10, "back[3]": 9, "t": 3, "total": 21, "most": 6, "least": -4, "scaled[2]": 3,
            "compr[3]": 9, "red": 18, "two[2,1]": 21, "nested[3,2]": 32, "e[2].y": 2.5, "slice": 7.5, "some": 6,
            "lastE": 3.5, "zero": 0, "m": 3, "out": 10, "lin[2]": 1.5, "id": 3, "c3[3]": 1, "cat1": 6,
            "cat2[2,2]": 4, "elementwise[2]": 2, "pick": 20, "fromRange": 16, "down": 6, "g[2]": 10, "diag": 3,
            "nd": 2, "op": 6, "powers[2]": 9, "vectorised[1]": 1, "implied[3]": 6,
        },
    ),
    # specification 12: functions
    "functions": (
        """
        function divide input Real a; input Real b = 2; input Real c = a; output Real q = a/b; output Real r; algorithm r := c; end divide;
        function firstAbove input Real u[:]; input Real limit; output Integer k; algorithm k := 0;
          for i in 1:size(u, 1) loop if u[i] > limit then k := i; return; end if; end for; end firstAbove;
        function countdown input Integer n; output Integer steps; protected Integer m; algorithm m := n; steps := 0;
          while m > 0 loop m := m - 2; steps := steps + 1; if steps == 3 then break; end if; end while; end countdown;
        function clip input Real u; output Real y; algorithm if u > 1 then y := 1; return; elseif u < -1 then y := -1; return; end if; y := u; end clip;
        function bisect input Real c; output Real x; protected Real lo; Real hi; algorithm lo := 0; hi := 4;
          for i in 1:60 loop x := (lo + hi)/2; if x^2 > c then hi := x; else lo := x; end if; end for; end bisect;
        function fact input Integer n; output Integer y; algorithm y := if n <= 1 then 1 else n*fact(n - 1); end fact;
        record R Real a; Real b = 3; end R;
        function makeR input Real a; output R r; algorithm r.a := a; r.b := 2*a; end makeR;
        function useR input R r; output Real y; algorithm y := r.a + 10*r.b; end useR;
        function base input Real u; output Real y; protected Real k = 2; algorithm y := k*u; end base;
        function derived = base; function changed extends base(k = 5); end changed;
        function second input Real a; input Real b; output Real y = b; end second;
        function ignored input Real u; output Real y; protected Real a; algorithm y := second(a, u); end ignored;
        function guarded input Real u; output Real y; algorithm assert(u > -10, "too low"); y := sqrt(u + 10); end guarded;
        function sorted input Real u[3]; output Real v[3]; protected Real t; algorithm v := u;
          for i in 1:2 loop for j in 1:3 - i loop if v[j] > v[j + 1] then t := v[j]; v[j] := v[j + 1]; v[j + 1] := t; end if; end for; end for; end sorted;
        function between input Real x; input Real t[:, 2]; output Real y; protected Integer i; algorithm i := 1;
          while x >= t[i + 1, 1] loop i := i + 1; end while; y := t[i, 2] + (x - t[i, 1])/(t[i + 1, 1] - t[i, 1])*(t[i + 1, 2] - t[i, 2]); end between;
        function heron "square root" input Real c; output Real x; output Real n; protected Real e; algorithm x := c; e := 1; n := 0;
          while e > 1e-13 loop e := abs(x - c/x); x := (x + c/x)/2; n := n + 1; end while; end heron;
        function doubled input Real u; output Real y; algorithm y := u; while y < 10 loop y := 2*y; if y > 1000 then return; end if; end while; y := -y; end doubled;
        model M
          Real heron2 = heron(2 + time); Real slope = der(heron2); Real twice = doubled(3 - time); Real no = doubled(11 + time); Real heronP = heron(p + 2);
          Real looked1 = between(time + 0.5, [0, 1; 1, 3; 2, 7; 4, 7]); Real looked2 = between(time + 1.5, [0, 1; 1, 3; 2, 7; 4, 7]); Real looked3 = between(3 - time, [0, 1; 1, 3; 2, 7; 4, 8]);
          parameter Real p = 7; parameter Real w[4] = {1, 4, 9, 16}; Real d1 = divide(8); Real d2 = divide(8, 4); Real d3 = divide(b = 16, a = 8); Real q; Real r;
          Real only; Real z = divide(time + 6); Real k5 = firstAbove(w, 5); Real k0 = firstAbove(w, 50); Real steps = countdown(4); Real broken = countdown(100);
          Real c1 = clip(p); Real c2 = clip(-p); Real c3 = clip(p/70); Real root = bisect(p + 2); Real f5 = fact(5);
          R rec = makeR(4); R rec2(a = 1); Real u1 = useR(rec); Real u2 = useR(R(1, 2)); Real u3 = useR(rec2); R arrayOfR[2](a = {1, 2}); Real u4 = useR(arrayOfR[2]);
          Real der1 = derived(3); Real ch = changed(3); Real gd = guarded(p - 1); Real ig = ignored(p); Real s3[3] = sorted({p, 3, 5}); Real bs[2] = base({1, 2});
          Real dynamic = firstAbove(w, p); Real integral(start = 0);
        equation
          (q, r) = divide(9, 3); (, only) = divide(1, 2, 33);
          der(integral) = clip(integral + 5);
        end M;
        """,
        {
            "looked1": 2, "looked2": 5, "looked3": 7.5, "d1": 4, "d2": 2, "d3": 0.5, "q": 3, "r": 9, "only": 33, "z": 3, "k5": 3, "k0": 0, "steps": 2,
            "broken": 3, "c1": 1, "c2": -1, "c3": 0.1, "root": 3, "f5": 120, "rec.b": 8, "u1": 84, "u2": 21,
            "u3": 31, "u4": 32, "der1": 6, "ch": 15, "gd": 4, "ig": 7, "s3[1]": 3, "s3[3]": 7, "bs[2]": 4, "dynamic": 3,
            "der(integral)": 1, "heron2": 2**0.5, "slope": 0.5 / 2**0.5, "twice": -12, "no": -11, "heronP": 3,
        },
    ),
    # conditional components, inner and outer, connections
    "structure": (
        """
        connector Pin Real v; flow Real i; end Pin; connector In = input Real; connector Out = output Real;
        model Ground Pin p; equation p.v = 0; end Ground;
        partial model Two Pin p; Pin n; Real v = p.v - n.v; Real i = p.i; equation p.i + n.i = 0; end Two;
        model Res extends Two; parameter Real R = 1; equation v = R*i; end Res;
        model Src extends Two; parameter Real V = 10; equation v = V; end Src;
        model Ladder parameter Integer n = 3; Res r[n](each R = 2); Pin a; Pin b; equation connect(a, r[1].p);
          for k in 1:n - 1 loop connect(r[k].n, r[k + 1].p); end for; connect(r[n].n, b); end Ladder;
        model Gain parameter Real k = 1; In u; Out y; equation y = k*u; end Gain;
        model Option parameter Boolean extra = false; Res r(R = 4); Res e(R = 4) if extra; Pin a; Pin b;
          equation connect(a, r.p); connect(r.n, b); connect(a, e.p); connect(e.n, b); end Option;
        model World parameter Real g = 9; end World;
        model Body outer World world; Real w = 2*world.g; end Body;
        model Inner2 inner World world(g = 4); Body body; end Inner2;
        model Cell outer Pin rail; Pin p; parameter Real R = 1; equation connect(p, rail); p.v = R*p.i; end Cell;
        model Bank Pin rails[2]; Res d[2](R = {2, 3}); Pin out; equation connect(d.p, rails); for k in 1:2 loop connect(d[k].n, out); end for; end Bank;
        model Oil constant Real p0 = 1; function rho input Real p; output Real d; algorithm d := 870 + 2*(p - p0); end rho; end Oil;
        model Shift inner outer World world(g = 30); Body body; Real around = world.g; end Shift;
        model Vec In u[2]; Out y; equation y = u[1] + 10*u[2]; end Vec;
        expandable connector Axis Real angle; Boolean moves; end Axis;
        expandable connector Bus Axis axis1; Axis axis2; Real unused; Real set; end Bus;
        model Sender Bus bus; Out y = 6; Out a = 7; equation connect(y, bus.speed); connect(a, bus.axis2.angle); bus.set = 8; end Sender;
        model Receiver Bus bus; In u; In a; Real seen = u; Real set = bus.set; equation connect(bus.speed, u); connect(bus.axis2.angle, a); end Receiver;
        model Choice parameter Integer kind = 2; Real y; equation if kind == 1 then y = 1; elseif kind == 2 then y = 22; else y = 3; end if; end Choice;
        model M
          Src s; Ground g; Ladder l; Res open(R = 5); Option o; Option o2(extra = true); Gain g1(k = 3); Gain g2(k = 2);
          inner World world; Body body; Inner2 inner2; Vec vec; Sender sender; Receiver receiver; Choice ch; Choice ch1(kind = 1);
          inner Pin rail; Cell cells[2](R = {2, 3}); Src feed(V = 6); Ground earth;
          Bank bank; Src supplies[2](V = {8, 9}); Shift shift; Oil oil; Oil other(p0 = 3); Real rho = oil.rho(4) + 1000*other.rho(4);
        equation
          connect(s.p, l.a); connect(l.b, s.n); connect(s.n, g.p); connect(s.p, open.p);
          connect(s.p, o.a); connect(o.b, g.p); connect(s.p, o2.a); connect(o2.b, g.p);
          g1.u = 5; connect(g1.y, g2.u); connect(g1.y, vec.u[1]); connect(g2.y, vec.u[2]); connect(sender.bus, receiver.bus);
          connect(supplies.p, bank.rails); connect(supplies[1].n, bank.out); connect(supplies[2].n, bank.out); connect(bank.out, g.p);
          connect(feed.p, rail); connect(feed.n, earth.p);
        end M;
        """,
        {
            "l.a.i": 10 / 6, "l.r[2].v": 10 / 3, "l.r[3].p.v": 10 / 3, "open.i": 0, "open.n.v": 10, "o.r.i": 2.5,
            "o2.a.i": 5, "o2.e.i": 2.5, "s.i": -(10 / 6 + 2.5 + 5), "g.p.i": 0, "g2.y": 30, "vec.y": 315,
            "body.w": 18, "inner2.body.w": 8, "receiver.seen": 6, "receiver.a": 7, "receiver.set": 8, "ch.y": 22, "ch1.y": 1,
            "cells[1].p.i": 3, "cells[2].p.i": 2, "feed.i": -5, "bank.d[2].i": 3, "supplies[1].i": -4, "rho": 872876,
            "shift.around": 9, "shift.body.w": 60,
        },
    ),
    # algorithms and expressions
    "algorithms": (
        """
        model M
          parameter Integer n = 4; parameter Real p = 2.5; Real s; Real f; Real arr[3]; Integer i1; Boolean b1; Real w; Real chained; Real dx = der(sq); Real sq;
          Real x(start = 3, fixed = true); Real pw = 2^3; Real rd = rem(-7, 3); Real md = mod(-7, 3); Real dv = div(-7, 3); Real fl = floor(-2.5); Real ce = ceil(-2.5); Real it = integer(2.7);
          Real neg = -2^2; Real rel = if 1 < 2 and not 3 <= 2 or false then 1 else 0; Real sg = sign(-3); Real at = atan2(1, 1); Real sl = semiLinear(-2, 3, 5);
          Real hom = homotopy(actual = 3, simplified = 1); Real sm = smooth(0, if p > 1 then p else 0); Real ne = noEvent(if p > 1 then 7 else 8);
          parameter Real fromInitial(fixed = false); parameter Real initAlg(fixed = false); String name = "a";
        protected
          parameter String file = "x" + String(n);
        initial equation fromInitial = 3*p;
        initial algorithm initAlg := 0; for k in 1:n loop initAlg := initAlg + k; end for;
        equation der(x) = -x; sq = x^2;
        algorithm s := 0; for k in 1:n loop s := s + k; if s > 5 then s := s + 100; break; end if; end for;
        algorithm f := 1; for k in {2, 3} loop for j in 1:k loop f := f*j; end for; end for;
        algorithm for k in 1:3 loop arr[k] := k*p; end for; arr[2] := arr[2] + arr[1];
        algorithm i1 := 3; i1 := i1*i1; b1 := i1 == 9;
        algorithm w := 0; while w < 10 loop w := w + 3; end while;
        algorithm chained := if p < 1 then 1 elseif p < 2 then 2 elseif p < 3 then 3 else 4;
        end M;
        """.replace(' String name = "a";', ""),
        {
            "s": 106, "f": 12, "arr[2]": 7.5, "arr[3]": 7.5, "i1": 9, "b1": 1, "w": 12, "chained": 3, "pw": 8, "rd": -1,
            "md": 2, "dv": -2, "fl": -3, "ce": -2, "it": 2, "neg": -4, "rel": 1, "sg": -1, "at": math.pi / 4,
            "sl": -10, "hom": 3, "sm": 2.5, "ne": 7, "fromInitial": 7.5, "initAlg": 10, "dx": -18, "sq": 9,
        },
    ),
    # specification 10.3, 12.4: arrays of arrays, calls without results, subscripts of slices
    "calls": (
        """
        function check input Real u; algorithm assert(u > 0, "negative"); end check;
        function none input Real u; protected Real v; algorithm v := u; end none;
        model A Real v = 1; end A;
        model B A a[2](v = {3, 4}); end B;
        model M
          parameter Real p = 2; Real f[3, 2] = fill({1, p}, 3); Real a[2] = array(p, 5);
          parameter String names[:] = fill("", 0); B b; Real w[2] = 2*b.a.v; parameter Integer n = size(names, 1);
        equation check(p); none(p);
        end M;
        """,
        {"f[3,2]": 2, "f[1,1]": 1, "a[1]": 2, "a[2]": 5, "w[2]": 8, "n": 0},
    ),
    # specification 3.6.4, 10.3.3, 12.4.5: Strings, sizes that grow, indices of Booleans, defaults of records
    "texts": (
        """
        function positive input Integer x[:]; output Integer y[:];
          algorithm for i in 1:size(x, 1) loop if x[i] > 0 then y := cat(1, y, x[i:i]); end if; end for; end positive;
        type Switch = Boolean;
        record R Integer a; Integer b = c; constant Integer c = 42; constant Integer d; end R;
        model M
          String s; String t = s + "b"; String u[2]; Real a = if t == "ab" then 1 else 2; Real b = if u[2] == "   7" then 1 else 2;
          parameter Integer p[:] = {-2, 1, 0, 3} annotation(Evaluate = true); Integer q[:] = positive(p);
          Real w[Switch] = {5, 6}; Real off = w[false]; R r = R(2, d = 8); Real m[2, 2] = matrix({{{1}, {2}}, {{3}, {4}}});
          Real c = if String(2.34567, significantDigits = 3) == "2.35" and String(1.5, format = "4.2f") == "1.50" then 1 else 2;
        equation s = "a"; u[1] = "x"; u[2] = String(7, minimumLength = 4, leftJustified = false);
        end M;
        """,
        {"a": 1, "b": 1, "c": 1, "q[2]": 3, "off": 5, "r.b": 42, "r.d": 8, "m[2,1]": 3},
    ),
}  # fmt: skip

# Values of discrete variables after events at the times; in between nothing happens.
EVENTS = """
model M
  discrete Real hits(start = 0, fixed = true); Integer n(start = 0, fixed = true); Boolean on(start = false, fixed = true);
  Integer rises(start = 0, fixed = true); discrete Real v[2](each start = 0, each fixed = true); Integer first(start = 0, fixed = true);
  Integer alg(start = 0, fixed = true); Real held(start = 0, fixed = true); Integer elsewise(start = 0, fixed = true); discrete Real last(start = -1, fixed = true);
  Boolean toggled(start = false, fixed = true); Integer either(start = 0, fixed = true); Integer conditional(start = 0, fixed = true);
equation
  when time >= 1 then hits = pre(hits) + 1; end when;
  when sample(0, 2) then n = pre(n) + 1; end when;
  on = time >= 2;
  when on then rises = pre(rises) + 1; end when;
  when time >= 3 then v = {time, 2*time}; end when;
  when initial() then first = 5; end when;
  when time >= 5 then elsewise = 1; elsewhen time >= 4 then elsewise = 2; end when;
  when {time >= 1, time >= 4} then either = pre(either) + 1; last = time; end when;
  when sample(1, 1) then toggled = not pre(toggled); if time > 2.5 then conditional = pre(conditional) + 1; else conditional = 0; end if; end when;
algorithm
  when time >= 2 then alg := 10; elsewhen time >= 4 then alg := pre(alg) + 1; end when;
algorithm
  when sample(1, 1) then held := pre(held) + time; end when;
end M;
"""
TIMES = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
AFTER = {
    "hits": (0, 1, 1, 1, 1, 1), "n": (1, 1, 2, 2, 3, 3), "on": (0, 0, 1, 1, 1, 1), "rises": (0, 0, 1, 1, 1, 1),
    "v[2]": (0, 0, 0, 6, 6, 6), "first": (5, 5, 5, 5, 5, 5), "alg": (0, 0, 10, 10, 11, 11),
    "held": (0, 1, 3, 6, 10, 15), "elsewise": (0, 0, 0, 0, 2, 1), "either": (0, 1, 1, 1, 2, 2),
    "last": (-1, 1, 1, 1, 4, 4), "toggled": (0, 1, 0, 1, 0, 1), "conditional": (0, 0, 0, 1, 2, 3),
}  # fmt: skip


@cache
def compiled(group: str, folder: Path) -> CompiledModel:
    file = folder / f"{group}.mo"
    if group == "events":
        file.write_text(EVENTS)
        return compile_modelica(file, "M")
    file.write_text(f"package P\n{GROUPS[group][0]}\nend P;\n")
    return compile_modelica(file, "P.M")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("semantics")


@pytest.mark.parametrize(("group", "name"), [(g, n) for g, (_, cases) in GROUPS.items() for n in cases])
def test_values_at_the_start(group, name, folder):
    model = compiled(group, folder)
    instance = Instance.of(model)
    x = instance.start()
    variable = find(model, name)
    if variable.location.vector == "z":
        env = instance.env(0.0, x)
        z, *_ = instance.settle(env, init=1.0)
        got = z[variable.location.index]
    else:
        got = instance.get(name, 0.0, x)
    assert got == pytest.approx(GROUPS[group][1][name], rel=1e-12, abs=1e-12)


@cache
def histories(folder: Path) -> dict[str, list[float]]:
    model = compiled("events", folder)
    instance = Instance.of(model)
    env = instance.env(0.0, instance.start())
    out: dict[str, list[float]] = {name: [] for name in AFTER}
    for number, time in enumerate(TIMES):
        for event in (time - 0.5, time + 1e-9) if number else (time,):
            env[0] = event
            z, m, _ = instance.settle(env, init=0.0 if number else 1.0)
            env[5], env[6], env[7] = z, z, m
        if number == 0:  # leaving the initialisation
            z, m, _ = instance.settle(env)
            env[5], env[6], env[7] = z, z, m
        for name in AFTER:
            out[name].append(float(np.asarray(env[5])[find(model, name).location.index]))
    return out


@pytest.mark.parametrize("name", AFTER)
def test_values_after_events(name, folder):
    assert histories(folder)[name] == pytest.approx(AFTER[name], abs=1e-7)


def test_a_missing_inner_component_is_added_with_a_warning(tmp_path):
    (tmp_path / "M.mo").write_text(
        "model M model W parameter Real g = 9; end W; model A outer W w; Real x = w.g; end A;\n"
        "model B A a; end B;\nB b; A c; end M;"
    )
    model = compile_modelica(tmp_path / "M.mo", "M")
    instance = Instance.of(model, {"w.g": 4.0})
    assert instance.get("b.a.x", 0.0, instance.start()) == instance.get("c.x", 0.0, instance.start()) == 4.0
    assert model.warnings == ("M.mo:1: nothing has an inner 'w'; the model gets 'inner W w'",)


@pytest.mark.parametrize(
    ("body", "warning"),
    [
        ("Real x(start = 1, fixed = true, stateSelect = StateSelect.never); equation der(x) = -x;", "is a state"),
        ("Real v(stateSelect = StateSelect.always) = if time < 1 then 1 else 5;", "cannot be a state"),
        (
            "Real x(start = 1, fixed = true); Real y(stateSelect = StateSelect.always) = x; equation der(x) = -y;",
            "",
        ),
    ],
)
def test_a_state_select_that_is_not_followed_is_said(tmp_path, body, warning):
    (tmp_path / "M.mo").write_text(f"model M {body} end M;")
    warnings = compile_modelica(tmp_path / "M.mo", "M").warnings
    assert [w for w in warnings if "stateSelect" in w and warning in w] == [*warnings][: bool(warning)]


def test_a_protected_parameter_that_follows_from_constants_is_one(tmp_path):
    (tmp_path / "M.mo").write_text(
        "model M parameter Real n = 4 annotation(Evaluate = true); parameter Real a = 1; Real x(start = 1);\n"
        "protected parameter Real e = sqrt(n); parameter Real d = 2*a; parameter Real k = 3; equation der(x) = -e*d*k*x; end M;"
    )
    model = compile_modelica(tmp_path / "M.mo", "M")
    assert [v.name for v in model.variables if v.location.vector == "p"] == ["a", "k"]
    assert Instance.of(model, {"a": 5.0, "k": 7.0}).derivative(0.0, np.array([1.0])) == pytest.approx(-140.0)
